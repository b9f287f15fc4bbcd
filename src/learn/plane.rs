//! Policies of pushes in the plane: the Gaussian one, and one on the unit disc whose density is that of the
//! executed push.
//!
//! The Gaussian policy's entropy is that of its draw before the world scales it onto the disc. It has no
//! bound: where reward gives no direction, an entropy bonus widens the policy until its mean has no effect.
//!
//! On the disc, each coordinate of a point in the square [-1, 1]^2 is drawn from a truncated normal law, and
//! the concentric map of Shirley & Chiu (1997) takes the square onto the disc. The map scales every area by
//! pi/4, so density, entropy and mode of the push are those in the square, up to the constant log(4/pi). The
//! entropy is at most log(pi), that of the uniform law on the disc.
//!
//! The actor's outputs o give the centre `m = B tanh(o/B)` with B = 3/2, beyond the border of the square so
//! that the mode can lie on it. The constants c give the spread, `log s = log 0.05 + log(60) sigmoid(c)`.

use super::head::{Block, GaussianPolicy, Head, HeadOf, PolicyHead};
use super::options::{PlaneLaw, TrainOptions};
use super::truncated_normal::TruncatedNormal;
use crate::game::columns::Column;
use lava_envs::action::Plane;
use lava_envs::{Force, GaussianLaw};
use nalgebra::Vector2;
use rand::{Rng, RngExt};
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

/// Bound B of the centre's coordinates.
const FARTHEST: f64 = 1.5;

/// Bounds of the standard deviation s before truncation. At the upper one the law is uniform up to 0.001 nats
/// per coordinate.
const STD: [f64; 2] = [0.05, 3.0];

/// The policy on the unit disc.
#[derive(Debug, Clone, Copy)]
pub struct DiscPolicy {
    /// Standard deviation s at the start of training.
    pub initial_std: f64,
}

/// The laws of a point's coordinates, with the derivatives of m by o and of log s by c.
struct Square {
    axes: [TruncatedNormal; 2],
    by_output: [f64; 2],
    by_constant: [f64; 2],
}

impl Square {
    /// The laws of the parameters (o_x, o_y, c_x, c_y).
    fn new(parameters: &[f64]) -> Self {
        let range = (STD[1] / STD[0]).ln();
        let tanh: [f64; 2] = std::array::from_fn(|i| (parameters[i] / FARTHEST).tanh());
        let share: [f64; 2] = std::array::from_fn(|i| 1.0 / (1.0 + (-parameters[2 + i]).exp()));
        let axis =
            |i: usize| TruncatedNormal::new(FARTHEST * tanh[i], STD[0] * (range * share[i]).exp());
        Square {
            axes: [axis(0), axis(1)],
            by_output: tanh.map(|tanh| 1.0 - tanh * tanh),
            by_constant: share.map(|share| range * share * (1.0 - share)),
        }
    }
}

/// The concentric map from the square onto the disc: squares about the origin become circles.
fn onto_disc([a, b]: [f64; 2]) -> Force {
    let (radius, angle) = if a == 0.0 && b == 0.0 {
        (0.0, 0.0)
    } else if a.abs() > b.abs() {
        (a, FRAC_PI_4 * b / a)
    } else {
        (b, FRAC_PI_2 - FRAC_PI_4 * a / b)
    };
    Force(radius * Vector2::new(angle.cos(), angle.sin()))
}

/// The inverse of [`onto_disc`].
fn onto_square(Force(push): Force) -> [f64; 2] {
    let radius = push.norm().min(1.0);
    if push.x.abs() > push.y.abs() {
        let a = radius.copysign(push.x);
        [a, a * (push.y / push.x).atan() / FRAC_PI_4]
    } else if radius > 0.0 {
        let b = radius.copysign(push.y);
        [b * (push.x / push.y).atan() / FRAC_PI_4, b]
    } else {
        [0.0, 0.0]
    }
}

impl Head for DiscPolicy {
    type Given = ();
    type Choice = Force;

    fn outputs(&self) -> usize {
        2
    }

    fn constants(&self) -> Vec<f32> {
        let share = (self.initial_std / STD[0]).ln() / (STD[1] / STD[0]).ln();
        vec![(share / (1.0 - share)).ln() as f32; 2]
    }

    fn log_probability(&self, parameters: &[f64], _: &(), choice: &Force) -> f64 {
        let point = onto_square(*choice);
        let axes = Square::new(parameters).axes;
        // In the order of `gradients`: to the bit the same.
        (0..2).fold((4.0 / PI).ln(), |log, i| log + axes[i].at(point[i]).log_density)
    }

    fn gradients(
        &self,
        parameters: &[f64],
        _: &(),
        choice: &Force,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        let point = onto_square(*choice);
        let Square { axes, by_output, by_constant } = Square::new(parameters);
        let (mut log_probability, mut entropy) = ((4.0 / PI).ln(), (PI / 4.0).ln());
        for i in 0..2 {
            let at = axes[i].at(point[i]);
            let (own, [by_mean, by_std]) = axes[i].entropy();
            score[i] = at.score[0] * by_output[i];
            score[2 + i] = at.score[1] * by_constant[i];
            entropy_gradient[i] = by_mean * by_output[i];
            entropy_gradient[2 + i] = by_std * by_constant[i];
            log_probability += at.log_density;
            entropy += own;
        }
        (log_probability, entropy)
    }
}

impl PolicyHead for DiscPolicy {
    type Noise = GaussianLaw;

    fn noise(&self, _: &[f64]) -> GaussianLaw {
        GaussianLaw
    }

    fn realise(&self, parameters: &[f64], z: Vector2<f64>) -> Force {
        let axes = Square::new(parameters).axes;
        onto_disc([axes[0].at_normal(z.x), axes[1].at_normal(z.y)])
    }

    /// Straight from uniform numbers, which saves computing them from normal ones.
    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Force {
        let axes = Square::new(parameters).axes;
        onto_disc(axes.map(|axis| axis.quantile(random.random())))
    }

    fn greedy(&self, parameters: &[f64]) -> Force {
        onto_disc(Square::new(parameters).axes.map(|axis| axis.mode()))
    }

    fn probabilities(&self, _: &[f64], _: &mut Vec<f64>) -> bool {
        false
    }
}

/// The policy that the options select, `train.policy`.
#[derive(Debug, Clone, Copy)]
pub enum PlanePolicy {
    /// The Gaussian one.
    Gaussian(GaussianPolicy),
    /// The one on the disc.
    Disc(DiscPolicy),
}

impl HeadOf<Force> for Plane {
    type Head = PlanePolicy;

    fn check(options: &TrainOptions) -> Result<(), String> {
        let std = options.initial_std;
        if options.policy == PlaneLaw::Disc && !(std > STD[0] && std < STD[1]) {
            let [least, most] = STD;
            return Err(format!(
                "train.initial_std = {std} is not possible with train.policy = \"disc\"; use a number \
                 between {least} and {most}"
            ));
        }
        Ok(())
    }

    fn head(options: &TrainOptions) -> PlanePolicy {
        let initial_std = options.initial_std;
        match options.policy {
            PlaneLaw::Gaussian => PlanePolicy::Gaussian(GaussianPolicy { initial_std }),
            PlaneLaw::Disc => PlanePolicy::Disc(DiscPolicy { initial_std }),
        }
    }

    fn index(_: Force) -> usize {
        0
    }

    fn from_index(_: usize) -> Option<Force> {
        None
    }

    /// 16 full pushes, evenly round the circle, and none.
    fn repertoire() -> Vec<Force> {
        const DIRECTIONS: usize = 16;
        let push = |index: usize| {
            let (sin, cos) = (index as f64 * 2.0 * PI / DIRECTIONS as f64).sin_cos();
            Force(Vector2::new(cos, sin))
        };
        (0..DIRECTIONS).map(push).chain([Force(Vector2::zeros())]).collect()
    }
}

/// Asks the policy that is selected.
macro_rules! selected {
    ($policy:expr, $head:ident => $answer:expr) => {
        match $policy {
            PlanePolicy::Gaussian($head) => $answer,
            PlanePolicy::Disc($head) => $answer,
        }
    };
}

impl Head for PlanePolicy {
    type Given = ();
    type Choice = Force;

    fn outputs(&self) -> usize {
        selected!(self, head => head.outputs())
    }

    fn constants(&self) -> Vec<f32> {
        selected!(self, head => head.constants())
    }

    fn log_probability(&self, parameters: &[f64], given: &(), choice: &Force) -> f64 {
        selected!(self, head => head.log_probability(parameters, given, choice))
    }

    fn gradients(
        &self,
        parameters: &[f64],
        given: &(),
        choice: &Force,
        score: &mut [f64],
        entropy_gradient: &mut [f64],
    ) -> (f64, f64) {
        selected!(self, head => head.gradients(parameters, given, choice, score, entropy_gradient))
    }

    fn log_probabilities(
        &self,
        parameters: &[Column],
        given: &[()],
        choices: &[Force],
        log_probability: &mut Column,
    ) {
        selected!(self, head => {
            head.log_probabilities(parameters, given, choices, log_probability);
        });
    }

    fn gradients_of_block(&self, block: Block<'_, Self>) {
        let Block { parameters, given, choices, log_probability, entropy, score, entropy_gradient } =
            block;
        selected!(self, head => head.gradients_of_block(Block {
            parameters,
            given,
            choices,
            log_probability,
            entropy,
            score,
            entropy_gradient,
        }));
    }
}

impl PolicyHead for PlanePolicy {
    type Noise = GaussianLaw;

    fn noise(&self, parameters: &[f64]) -> GaussianLaw {
        selected!(self, head => head.noise(parameters))
    }

    fn realise(&self, parameters: &[f64], noise: Vector2<f64>) -> Force {
        selected!(self, head => head.realise(parameters, noise))
    }

    fn draw(&self, parameters: &[f64], random: &mut impl Rng) -> Force {
        selected!(self, head => head.draw(parameters, random))
    }

    fn greedy(&self, parameters: &[f64]) -> Force {
        selected!(self, head => head.greedy(parameters))
    }

    fn probabilities(&self, parameters: &[f64], probabilities: &mut Vec<f64>) -> bool {
        selected!(self, head => head.probabilities(parameters, probabilities))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    const POLICY: DiscPolicy = DiscPolicy { initial_std: 1.0 };

    #[test]
    fn the_map_and_its_inverse_agree_and_areas_shrink_by_pi_over_4() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..10_000 {
            let point = [random.random_range(-1.0..1.0), random.random_range(-1.0..1.0)];
            let push = onto_disc(point);
            assert!(push.0.norm() <= 1.0);
            let back = onto_square(push);
            assert!((0..2).all(|i| (back[i] - point[i]).abs() < 1e-12), "{point:?}: {back:?}");
            // The Jacobian, away from the diagonals, where the map has a kink.
            if (point[0].abs() - point[1].abs()).abs() > 1e-3 {
                let [x, y] = point;
                const STEP: f64 = 1e-6;
                let by_x = (onto_disc([x + STEP, y]).0 - onto_disc([x - STEP, y]).0) / (2.0 * STEP);
                let by_y = (onto_disc([x, y + STEP]).0 - onto_disc([x, y - STEP]).0) / (2.0 * STEP);
                let area = (by_x.x * by_y.y - by_x.y * by_y.x).abs();
                assert!((area - FRAC_PI_4).abs() < 1e-6, "{point:?}: {area}");
            }
        }
        for corner in [[1.0, 1.0], [-1.0, 1.0], [0.0, 0.0], [0.0, -1.0], [1.0, 0.0]] {
            let back = onto_square(onto_disc(corner));
            assert!((0..2).all(|i| (back[i] - corner[i]).abs() < 1e-12), "{corner:?}: {back:?}");
        }
    }

    /// Mean of log-probability and frequencies of a draw against the density that is written down.
    #[test]
    fn draws_have_the_density_and_the_entropy_that_are_written_down() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for parameters in [[0.0, 0.0, 0.0, 0.0], [0.9, -0.4, -1.0, -1.5], [3.0, 3.0, -0.5, 0.2]] {
            const DRAWS: usize = 40_000;
            let (mut sum, mut squares, mut right) = (0.0, 0.0, 0);
            let (mut score, mut by_entropy) = ([0.0; 4], [0.0; 4]);
            let mut entropy = 0.0;
            for _ in 0..DRAWS {
                let push = POLICY.draw(&parameters, &mut random);
                let (log, of) =
                    POLICY.gradients(&parameters, &(), &push, &mut score, &mut by_entropy);
                assert_eq!(log, POLICY.log_probability(&parameters, &(), &push));
                (sum, squares, entropy) = (sum + log, squares + log * log, of);
                right += usize::from(push.0.x > 0.3);
            }
            let mean = sum / DRAWS as f64;
            let error = ((squares / DRAWS as f64 - mean * mean) / DRAWS as f64).sqrt();
            assert!(
                (mean + entropy).abs() < 5.0 * error + 1e-9,
                "{parameters:?}: {mean}, {entropy}"
            );
            // The probability of x > 0.3 by a sum over a fine grid of the disc.
            const CELLS: usize = 800;
            let at = |i: usize| (2 * i + 1) as f64 / CELLS as f64 - 1.0;
            let mut probability = 0.0;
            for (x, y) in (0..CELLS).flat_map(|i| (0..CELLS).map(move |j| (at(i), at(j)))) {
                let push = Force(Vector2::new(x, y));
                if x > 0.3 && push.0.norm() <= 1.0 {
                    let log = POLICY.log_probability(&parameters, &(), &push);
                    probability += log.exp() * (2.0 / CELLS as f64).powi(2);
                }
            }
            let share = right as f64 / DRAWS as f64;
            assert!((share - probability).abs() < 0.015, "{parameters:?}: {share}, {probability}");
        }
    }

    /// Ascent along the entropy's gradient ends near the uniform law, at log(pi), and not beyond.
    #[test]
    fn the_bonus_alone_leaves_the_policy_near_uniform() {
        let mut parameters = [1.2, -0.8, -2.0, -1.0];
        let (mut score, mut by_entropy) = ([0.0; 4], [0.0; 4]);
        let mut entropy = 0.0;
        let origin = Force(Vector2::zeros());
        for _ in 0..20_000 {
            (_, entropy) = POLICY.gradients(&parameters, &(), &origin, &mut score, &mut by_entropy);
            for (parameter, by) in parameters.iter_mut().zip(by_entropy) {
                *parameter += 0.5 * by;
            }
        }
        assert!(entropy <= PI.ln() && entropy > PI.ln() - 0.01, "entropy {entropy}");
        // Every direction and length is about as likely as any other, and the mode still is a push.
        let log = |x, y| POLICY.log_probability(&parameters, &(), &Force(Vector2::new(x, y)));
        let logs = [log(0.0, 0.0), log(0.99, 0.0), log(0.0, -0.99), log(-0.7, 0.7)];
        assert!(logs.iter().all(|log| (log + PI.ln()).abs() < 0.1), "{logs:?}");
        assert!(POLICY.greedy(&parameters).0.norm() <= 1.0);
    }
}
