//! The game against independent truth: quadrature, finite differences, and trajectories in both
//! worlds.

use approx::{assert_abs_diff_eq, assert_relative_eq};
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::bump::Bump;
use cvar_game::game::columns::SAMPLES;
use cvar_game::game::finite::FiniteFamily;
use cvar_game::game::gaussian::{Component, GaussianFamily, GaussianPerturbation, MOST};
use cvar_game::game::perturbation::{Draws, Family, Perturbation};
use cvar_game::game::probit::Probit;
use cvar_game::game::shift::Shift;
use lava_envs::{FiniteLaw, GaussianLaw, Law};
use nalgebra::{Matrix2, Vector2};
use proptest::prelude::*;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::ops::Range;

fn family<C: Component>(count: usize) -> GaussianFamily<C> {
    GaussianFamily::new(count, 4.0, 50.0)
}

/// A family with its parameters, the logits of its weights included.
fn gaussians<C: Component>(
    range: Range<f64>,
) -> impl Strategy<Value = (GaussianFamily<C>, Vec<f64>)> {
    (1..=MOST).prop_flat_map(move |components| {
        let family = family(components);
        let count = family.parameters();
        (Just(family), prop::collection::vec(range.clone(), count))
    })
}

fn budget(eta: f64) -> Budget {
    Budget::start(Eta::new(eta).unwrap())
}

/// Budgets from exactly 1 and barely above to large.
fn budgets() -> impl Strategy<Value = f64> {
    prop_oneof![
        Just(1.0),
        (1e-12f64..1e-3).prop_map(|x| 1.0 + x),
        1.0f64..3.0,
        (1.0f64..12.0).prop_map(f64::exp),
    ]
}

fn probabilities() -> impl Strategy<Value = [f64; 4]> {
    (prop::array::uniform4(0.0f64..1.0), prop::array::uniform4(prop::bool::weighted(0.15)))
        .prop_map(|(mut weights, absent)| {
            for i in 0..4 {
                weights[i] = if absent[i] { 0.0 } else { weights[i] + 1e-3 };
            }
            if weights.iter().sum::<f64>() == 0.0 {
                weights[2] = 1.0;
            }
            let sum: f64 = weights.iter().sum();
            weights.map(|weight| weight / sum)
        })
}

/// The integral of f over the plane by Simpson's rule on [-r, r]^2 around a centre.
fn integrate(f: impl Fn(Vector2<f64>) -> f64, center: Vector2<f64>, r: f64, cells: usize) -> f64 {
    let h = 2.0 * r / cells as f64;
    let weight = |i: usize| match i {
        0 => 1.0,
        i if i == cells => 1.0,
        i if i % 2 == 1 => 4.0,
        _ => 2.0,
    };
    let mut sum = 0.0;
    for i in 0..=cells {
        for j in 0..=cells {
            let at = center + Vector2::new(-r + h * i as f64, -r + h * j as f64);
            sum += weight(i) * weight(j) * f(at);
        }
    }
    sum * h * h / 9.0
}

/// Central finite differences of `f` at `x`.
fn differences(f: impl Fn(&[f64]) -> f64, x: &[f64]) -> Vec<f64> {
    (0..x.len())
        .map(|i| {
            let h = 1e-5;
            let shifted = |by: f64| {
                let mut x = x.to_vec();
                x[i] += by;
                f(&x)
            };
            (shifted(h) - shifted(-h)) / (2.0 * h)
        })
        .collect()
}

fn assert_gradient(written: &[f64], numeric: &[f64]) {
    for (written, numeric) in written.iter().zip(numeric) {
        let scale = 1.0 + numeric.abs();
        assert!((written - numeric).abs() < 2e-5 * scale, "{written} against {numeric}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn finite_perturbations_are_admissible(
        logits in prop::array::uniform4(-30.0f64..30.0),
        p in probabilities(),
        eta in budgets(),
    ) {
        let law = FiniteLaw { probabilities: p };
        let perturbation = FiniteFamily.perturbation(&logits, &law, budget(eta));
        let mean: f64 = (0..4).map(|i| p[i] * perturbation.likelihood_ratio(i)).sum();
        prop_assert!((mean - 1.0).abs() < 1e-9, "E[delta] = {mean}");
        let supremum = (0..4)
            .filter(|&i| p[i] > 0.0)
            .map(|i| perturbation.likelihood_ratio(i))
            .fold(0.0, f64::max);
        prop_assert!(supremum <= eta * (1.0 + 1e-9), "sup delta = {supremum} of {eta}");
        prop_assert!((supremum - perturbation.supremum()).abs() <= 1e-9 * supremum);
        if eta == 1.0 {
            prop_assert!((0..4).all(|i| perturbation.likelihood_ratio(i) == 1.0));
        }
    }

    #[test]
    fn sums_of_bumps_are_admissible(
        (family, parameters) in gaussians::<Bump>(-5.0..5.0),
        xi in prop::array::uniform2(-5.0f64..5.0),
        eta in budgets(),
    ) {
        check_admissible(&family, &parameters, Vector2::from(xi), eta)?;
        for (_, bump) in family.perturbation(&parameters, &GaussianLaw, budget(eta)).components() {
            prop_assert!(bump.center().norm() < family.center_bound);
            let largest = bump.curvature().symmetric_eigenvalues().max();
            prop_assert!(largest <= family.curvature_bound);
        }
    }

    #[test]
    fn sums_of_probits_are_admissible(
        (family, parameters) in gaussians::<Probit>(-5.0..5.0),
        xi in prop::array::uniform2(-5.0f64..5.0),
        eta in budgets(),
    ) {
        check_admissible(&family, &parameters, Vector2::from(xi), eta)?;
        for (_, step) in family.perturbation(&parameters, &GaussianLaw, budget(eta)).components() {
            prop_assert!(step.threshold().abs() < family.center_bound);
            prop_assert!(step.slope().norm_squared() < family.curvature_bound);
        }
    }

    #[test]
    fn finite_gradients_equal_finite_differences(
        logits in prop::array::uniform4(-3.0f64..3.0),
        p in probabilities(),
        eta in prop_oneof![Just(1.0), 1.05f64..40.0],
        outcome in 0usize..4,
    ) {
        let law = FiniteLaw { probabilities: p };
        prop_assume!(p[outcome] > 0.0);
        // Where two logits tie for the top or M meets the budget the derivative jumps.
        let at = |x: &[f64]| FiniteFamily.perturbation(x, &law, budget(eta));
        let free = FiniteFamily.perturbation(&logits, &law, budget(1e9));
        prop_assume!((free.supremum() - eta).abs() > 1e-2);
        let mut sorted: Vec<f64> = (0..4).filter(|&i| p[i] > 0.0).map(|i| logits[i]).collect();
        sorted.sort_by(f64::total_cmp);
        prop_assume!(sorted.len() < 2 || sorted[sorted.len() - 1] - sorted[sorted.len() - 2] > 1e-3);

        let mut gradient = [0.0; 4];
        at(&logits).score(outcome, &mut gradient);
        assert_gradient(&gradient, &differences(|x| at(x).likelihood_ratio(outcome).ln(), &logits));
        at(&logits).entropy(&mut gradient);
        let entropy = |x: &[f64]| -> f64 {
            -at(x).probabilities().iter().filter(|&&q| q > 0.0).map(|q| q * q.ln()).sum::<f64>()
        };
        assert_gradient(&gradient, &differences(entropy, &logits));
    }

    #[test]
    fn gradients_of_bumps_equal_finite_differences(
        (family, parameters) in gaussians::<Bump>(-2.0..2.0),
        xi in prop::array::uniform2(-3.0f64..3.0),
        eta in prop_oneof![Just(1.0), 1.05f64..200.0],
    ) {
        check_gradients(&family, &parameters, Vector2::from(xi), eta)?;
    }

    #[test]
    fn gradients_of_probits_equal_finite_differences(
        (family, parameters) in gaussians::<Probit>(-2.0..2.0),
        xi in prop::array::uniform2(-3.0f64..3.0),
        eta in prop_oneof![Just(1.0), 1.05f64..200.0],
    ) {
        check_gradients(&family, &parameters, Vector2::from(xi), eta)?;
    }
}

/// Draws in columns are those of the formulas for one sample, with the same random numbers.
fn check_draws<F: Family>(family: &F, law: F::Law, close: impl Fn(Outcome<F>, Outcome<F>) -> bool) {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for count in [1, SAMPLES - 1, SAMPLES] {
        let parameters: Vec<[f64; SAMPLES]> = (0..family.parameters())
            .map(|_| std::array::from_fn(|_| random.random_range(-3.0..3.0)))
            .collect();
        let budgets: Vec<Budget> = (0..count)
            .map(|i| if i == 0 { budget(1.0) } else { budget(random.random_range(1.0..40.0)) })
            .collect();
        for nominal in [false, true] {
            let stream = |i: usize| ChaCha8Rng::seed_from_u64(i as u64);
            let mut streams: Vec<ChaCha8Rng> = (0..count).map(stream).collect();
            let (mut outcomes, mut ratios, mut error) = (Vec::new(), vec![0.0; count], 0.0);
            family.draw(Draws {
                parameters: &parameters,
                laws: &vec![law; count],
                budgets: &budgets,
                random: &mut streams.iter_mut().collect::<Vec<_>>(),
                nominal,
                outcomes: &mut outcomes,
                ratios: &mut ratios,
                normalisation_error: Some(&mut error),
            });
            assert!(error < 1e-9, "{error}");
            for i in 0..count {
                let own: Vec<f64> = parameters.iter().map(|column| column[i]).collect();
                let perturbation = family.perturbation(&own, &law, budgets[i]);
                let random = &mut stream(i);
                let outcome =
                    if nominal { law.sample(random) } else { perturbation.sample(random) };
                assert!(close(outcomes[i], outcome), "{:?}, {outcome:?}", outcomes[i]);
                let ratio = perturbation.likelihood_ratio(outcome);
                assert!((ratios[i] / ratio - 1.0).abs() < 1e-9, "{}, {ratio}", ratios[i]);
            }
        }
    }
}

/// The audit of draws in columns is that of single samples, where there is something to find: chances that do not sum
/// to 1.
#[test]
fn the_audit_of_draws_finds_what_is_not_normalised() {
    let (family, law) = (FiniteFamily::<4>, FiniteLaw { probabilities: [0.0, 0.2, 0.3, 0.4] });
    let parameters = [[0.0; SAMPLES], [0.5; SAMPLES], [-0.5; SAMPLES], [2.0; SAMPLES]];
    let budgets = [1.2, 1.5].map(budget);
    let mut error = 0.0;
    family.draw(Draws {
        parameters: &parameters,
        laws: &[law; 2],
        budgets: &budgets,
        random: &mut [ChaCha8Rng::seed_from_u64(1), ChaCha8Rng::seed_from_u64(2)].each_mut(),
        nominal: false,
        outcomes: &mut Vec::new(),
        ratios: &mut [0.0; 2],
        normalisation_error: Some(&mut error),
    });
    let single = |budget| {
        family.perturbation(&parameters.map(|column| column[0]), &law, budget).normalisation_error()
    };
    let expected = budgets.map(single).into_iter().fold(0.0, f64::max);
    assert!(expected > 0.01 && (error - expected).abs() < 1e-12, "{error}, {expected}");
}

type Outcome<F> = <<F as Family>::Law as Law>::Outcome;

#[test]
fn draws_in_columns_are_those_of_single_samples() {
    let law = FiniteLaw { probabilities: [0.0, 0.2, 0.3, 0.5] };
    check_draws(&FiniteFamily::<4>, law, |a, b| a == b);
    for count in 1..=MOST {
        let close = |a: Vector2<f64>, b: Vector2<f64>| (a - b).norm() < 1e-9;
        check_draws(&GaussianFamily::<Bump>::new(count, 4.0, 50.0), GaussianLaw, close);
        check_draws(&GaussianFamily::<Probit>::new(count, 4.0, 50.0), GaussianLaw, close);
    }
}

fn check_admissible<C: Component>(
    family: &GaussianFamily<C>,
    parameters: &[f64],
    xi: Vector2<f64>,
    eta: f64,
) -> Result<(), TestCaseError> {
    let perturbation = family.perturbation(parameters, &GaussianLaw, budget(eta));
    prop_assert!(perturbation.supremum() <= eta * (1.0 + 1e-9));
    let ratio = perturbation.likelihood_ratio(xi);
    prop_assert!(ratio > 0.0 || eta > 1.0);
    prop_assert!(ratio <= perturbation.supremum() * (1.0 + 1e-12));
    prop_assert!(perturbation.normalisation_error() < 1e-9);
    let sum: f64 = perturbation.components().map(|(weight, _)| weight).sum();
    prop_assert!((sum - 1.0).abs() < 1e-12);
    if eta == 1.0 {
        prop_assert_eq!(ratio, 1.0);
    }
    Ok(())
}

fn check_gradients<C: Component>(
    family: &GaussianFamily<C>,
    parameters: &[f64],
    xi: Vector2<f64>,
    eta: f64,
) -> Result<(), TestCaseError> {
    let at = |x: &[f64]| family.perturbation(x, &GaussianLaw, budget(eta));
    prop_assume!((at(parameters).base_supremum() - eta).abs() > 1e-2 * eta);
    let mut gradient = vec![0.0; parameters.len()];
    at(parameters).score(xi, &mut gradient);
    assert_gradient(&gradient, &differences(|x| at(x).likelihood_ratio(xi).ln(), parameters));
    let scratch = gradient.clone();
    at(parameters).entropy(&mut gradient);
    let entropy = |x: &[f64]| at(x).entropy(&mut scratch.clone());
    assert_gradient(&gradient, &differences(entropy, parameters));
    Ok(())
}

/// The perturbed density integrates to 1.
fn check_integral<C: Component>(perturbation: &GaussianPerturbation<C>) {
    let density =
        |xi: Vector2<f64>| GaussianLaw.log_density(xi).exp() * perturbation.likelihood_ratio(xi);
    let total = integrate(density, Vector2::zeros(), 10.0, 800);
    assert!((total - 1.0).abs() < 1e-6, "E[delta] = {total}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Z, M, m and S of a bump against quadrature of their definitions.
    #[test]
    fn a_bump_equals_quadrature(parameters in prop::array::uniform5(-6.0f64..6.0)) {
        let bump = Bump::new(&parameters, 0, 4.0, 50.0);
        let (c, k) = (bump.center(), bump.curvature());
        let kernel = |xi: Vector2<f64>| {
            (GaussianLaw.log_density(xi) - 0.5 * (xi - c).dot(&(k * (xi - c)))).exp()
        };
        let z = integrate(kernel, Vector2::zeros(), 10.0, 800);
        assert_relative_eq!(bump.log_supremum(), -z.ln(), epsilon = 1e-7);
        assert_relative_eq!(bump.log_integral(), z.ln(), epsilon = 1e-7);

        let mean = |i: usize| integrate(|xi| xi[i] * kernel(xi), Vector2::zeros(), 10.0, 800) / z;
        let m = Vector2::new(mean(0), mean(1));
        assert_relative_eq!(bump.mean(), m, epsilon = 1e-7);
        let second = |i: usize, j: usize| {
            let f = |xi: Vector2<f64>| (xi[i] - m[i]) * (xi[j] - m[j]) * kernel(xi);
            integrate(f, Vector2::zeros(), 10.0, 800) / z
        };
        let s = Matrix2::new(second(0, 0), second(0, 1), second(0, 1), second(1, 1));
        assert_relative_eq!(bump.covariance(), s, epsilon = 1e-7);
        let xi = Vector2::new(0.3, -0.7);
        assert_relative_eq!(
            bump.likelihood_ratio(xi).ln(), (kernel(xi) / z).ln() - GaussianLaw.log_density(xi),
            epsilon = 1e-6
        );
    }

    /// The perturbed density integrates to 1, and M bounds the ratio; it is attained by one bump.
    #[test]
    fn sums_of_bumps_equal_quadrature(
        (family, parameters) in gaussians::<Bump>(-6.0..6.0),
        eta in prop_oneof![
            (1e-9f64..1e-3).prop_map(|x| 1.0 + x), 1.0f64..200.0, Just(1e12),
        ],
    ) {
        let perturbation = family.perturbation(&parameters, &GaussianLaw, budget(eta));
        check_integral(&perturbation);
        for (_, bump) in perturbation.components() {
            let c = bump.center();
            let top = perturbation.likelihood_ratio(c);
            prop_assert!(top <= perturbation.supremum() * (1.0 + 1e-12));
            if family.count == 1 {
                let supremum = perturbation.base_supremum().min(eta);
                assert_relative_eq!(top, supremum, max_relative = 1e-9);
                for step in 0..8 {
                    let angle = f64::from(step) * std::f64::consts::FRAC_PI_4;
                    let near = c + Vector2::new(angle.cos(), angle.sin()) * 0.1;
                    prop_assert!(perturbation.likelihood_ratio(near) <= top);
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// The perturbed density integrates to 1, and the ratio rises to M along w.
    #[test]
    fn sums_of_probits_equal_quadrature(
        (family, parameters) in gaussians::<Probit>(-6.0..6.0),
        eta in prop_oneof![
            (1e-9f64..1e-3).prop_map(|x| 1.0 + x), 1.0f64..200.0, Just(1e12),
        ],
    ) {
        let perturbation = family.perturbation(&parameters, &GaussianLaw, budget(eta));
        check_integral(&perturbation);
        for (_, step) in perturbation.components() {
            let far = step.slope().normalize() * 1e3;
            assert_relative_eq!(
                step.likelihood_ratio(far).ln(), step.log_supremum(), epsilon = 1e-9
            );
            prop_assert!(step.likelihood_ratio(-far) < 1e-9);
        }
    }
}

/// At the largest bounds and with extreme parameters everything stays finite.
#[test]
fn extreme_probits_stay_finite() {
    let family = GaussianFamily::<Probit>::new(1, 100.0, 1e6);
    for parameters in [[1e6, 0.0, 1e6], [0.0, -1e6, -1e6], [1e-6, 0.0, 1e6], [1e6, 1e6, 0.0]] {
        for eta in [1.0, 1.5, 1e6, 1e290] {
            let perturbation = family.perturbation(&parameters, &GaussianLaw, budget(eta));
            let mut random = ChaCha8Rng::seed_from_u64(7);
            for _ in 0..100 {
                let xi = perturbation.sample(&mut random);
                let mut gradient = [0.0; 3];
                let ratio = perturbation.score(xi, &mut gradient);
                assert!(xi.iter().chain(&gradient).all(|x| x.is_finite()), "{xi} {gradient:?}");
                assert!(ratio > 0.0 && ratio <= eta * (1.0 + 1e-9), "{ratio} of {eta}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// A shift is the normal law that it says it is, within its relative entropy, by quadrature; its score is that of
    /// finite differences.
    #[test]
    fn shifts_are_forces_within_a_relative_entropy(
        parameters in prop::array::uniform2(-5.0f64..5.0),
        eta in 1.0f64..8.0,
        xi in prop::array::uniform2(-3.0f64..3.0),
    ) {
        let shift = |z: &[f64]| Shift.perturbation(z, &GaussianLaw, budget(eta));
        let of = shift(&parameters);
        let perturbed = |xi: Vector2<f64>| GaussianLaw.log_density(xi).exp() * of.likelihood_ratio(xi);
        let mean = of.mean();
        let integral = |f: &dyn Fn(Vector2<f64>) -> f64| {
            integrate(|xi| f(xi) * perturbed(xi), mean, 8.0, 200)
        };
        assert_abs_diff_eq!(integral(&|_| 1.0), 1.0, epsilon = 1e-9);
        assert_abs_diff_eq!(integral(&|xi| xi.x), mean.x, epsilon = 1e-9);
        assert_abs_diff_eq!(integral(&|xi| xi.y), mean.y, epsilon = 1e-9);
        let relative_entropy = integral(&|xi| of.likelihood_ratio(xi).ln());
        prop_assert!(relative_entropy <= eta.ln() + 1e-9);
        let far = Shift.perturbation(&[parameters[0] * 1e6, parameters[1] * 1e6], &GaussianLaw, budget(eta));
        if parameters[0] != 0.0 {
            assert_abs_diff_eq!(0.5 * far.mean().norm_squared(), eta.ln(), epsilon = 1e-6);
        }
        let entropy = -integral(&|xi| perturbed(xi).max(f64::MIN_POSITIVE).ln());
        let mut gradient = [0.0; 2];
        assert_abs_diff_eq!(of.entropy(&mut gradient), entropy, epsilon = 1e-6);
        prop_assert_eq!(gradient, [0.0; 2]);

        let xi = Vector2::from(xi);
        let ratio = of.score(xi, &mut gradient);
        assert_relative_eq!(ratio, of.likelihood_ratio(xi), epsilon = 1e-12);
        let log = |z: &[f64]| shift(z).likelihood_ratio(xi).ln();
        assert_gradient(&gradient, &differences(log, &parameters));
    }
}

/// Draws of a shift have its mean and unit variance.
#[test]
fn draws_follow_their_shift() {
    let shift = Shift.perturbation(&[-1.0, 2.0], &GaussianLaw, budget(2.0));
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let n = 400_000;
    let (mut first, mut second) = (Vector2::zeros(), Vector2::zeros());
    for _ in 0..n {
        let from_mean = shift.sample(&mut random) - shift.mean();
        first += from_mean / f64::from(n);
        second += from_mean.component_mul(&from_mean) / f64::from(n);
    }
    assert!(
        first.norm() < 0.01 && (second - Vector2::new(1.0, 1.0)).norm() < 0.015,
        "{first} {second}"
    );
}

/// Draws follow the density: moments against quadrature. Steep and mild steps, likely and rare ones.
#[test]
fn draws_follow_their_probits() {
    let mild = [0.1, -0.05, 0.0];
    let steep = [-2.0, 1.0, 0.5];
    let sum = [&mild[..], &steep, &[0.3, -0.4]].concat();
    for parameters in [mild.to_vec(), steep.to_vec(), sum] {
        let family = family::<Probit>(if parameters.len() > 3 { 2 } else { 1 });
        let perturbation = family.perturbation(&parameters, &GaussianLaw, budget(6.0));
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let n = 400_000;
        let draws: Vec<_> = (0..n).map(|_| perturbation.sample(&mut random)).collect();
        let moments: [fn(Vector2<f64>) -> f64; 6] = [
            |xi| xi.x,
            |xi| xi.y,
            |xi| xi.x * xi.x,
            |xi| xi.x * xi.y,
            |xi| xi.y * xi.y,
            |xi| xi.x.powi(2) * xi.y,
        ];
        for moment in moments {
            let of_draws = draws.iter().map(|&xi| moment(xi)).sum::<f64>() / f64::from(n);
            let weighted = |xi| {
                let density = GaussianLaw.log_density(xi).exp();
                moment(xi) * density * perturbation.likelihood_ratio(xi)
            };
            let expected = integrate(weighted, Vector2::zeros(), 10.0, 800);
            assert!((of_draws - expected).abs() < 0.015, "{of_draws} against {expected}");
        }
    }
}

/// Draws follow the density: first and second moments of the mixture.
#[test]
fn draws_follow_their_mixture() {
    let one = [0.8, -0.5, 0.1, 0.2, 0.3].to_vec();
    let two = [one.clone(), [-0.6, 0.2, 0.4, -0.1, 0.2, 0.3, -0.2].to_vec()].concat();
    for parameters in [one, two] {
        let family = family::<Bump>(parameters.len() / Bump::PARAMETERS);
        let perturbation = family.perturbation(&parameters, &GaussianLaw, budget(6.0));
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let n = 400_000;
        let draws: Vec<_> = (0..n).map(|_| perturbation.sample(&mut random)).collect();
        let weight = perturbation.weight();
        assert!(weight > 0.05 && weight < 1.0, "the budget should bind: {weight}");
        let mut expected_mean = Vector2::zeros();
        let mut expected = Matrix2::identity() * (1.0 - weight);
        for (share, bump) in perturbation.components() {
            let m = bump.mean();
            expected_mean += m * (weight * share);
            expected += (bump.covariance() + m * m.transpose()) * (weight * share);
        }
        let mean = draws.iter().sum::<Vector2<f64>>() / f64::from(n);
        assert!((mean - expected_mean).norm() < 0.01, "{mean} against {expected_mean}");
        let second: Matrix2<f64> =
            draws.iter().map(|d| d * d.transpose()).sum::<Matrix2<f64>>() / f64::from(n);
        assert!((second - expected).norm() < 0.02, "{second} against {expected}");
        // Importance weights undo the perturbation: E_Q[1/delta] = 1.
        let back: f64 = draws.iter().map(|&d| 1.0 / perturbation.likelihood_ratio(d)).sum();
        assert!((back / f64::from(n) - 1.0).abs() < 0.01);
    }
}

#[test]
fn budgets_refuse_what_is_none() {
    for eta in [0.99, 0.0, -3.0, f64::NAN, f64::INFINITY] {
        let message = Eta::new(eta).unwrap_err().to_string();
        assert!(message.contains("at least 1"), "{message}");
    }
    assert_eq!(Eta::new(25.0).unwrap().to_string(), "25");
    assert_eq!("2.5".parse::<Eta>().unwrap().alpha(), 0.4);
}

#[test]
#[should_panic(expected = "not admissible")]
fn an_inadmissible_ratio_is_caught() {
    let _ = budget(2.0).spend(2.1);
}

#[test]
fn a_small_ratio_raises_the_budget() {
    assert_eq!(budget(4.0).spend(0.5).get(), 8.0);
    assert_eq!(budget(4.0).spend(4.0).get(), 1.0);
}

/// Far from a narrow bump delta^0 rounds to 0, and with that ratio no budget could be spent.
#[test]
fn a_ratio_that_rounds_to_zero_leaves_a_finite_budget() {
    // c and K at their bounds along x, and budget enough for the bump alone.
    let perturbation =
        family::<Bump>(1).perturbation(&[1e6, 0.0, 1e6, 0.0, 0.0], &GaussianLaw, budget(1e6));
    assert_eq!(perturbation.weight(), 1.0);
    let ratio = perturbation.likelihood_ratio(Vector2::new(-3.0, 0.0));
    assert!(ratio > 0.0 && ratio < 1e-300, "{ratio}");
    let mut left = budget(1e6);
    for _ in 0..40 {
        left = left.spend(ratio);
        assert!(left.get().is_finite());
    }
}
