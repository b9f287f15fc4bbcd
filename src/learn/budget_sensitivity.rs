//! How the antagonist's value depends on its remaining budget, which its policy gradient must count.
//!
//! The antagonist's law decides the odds of an outcome and, at the same time, the budget that remains when it
//! happens: eta_{t+1} = eta_t / delta_t(o_t). With V(s, eta) its value, Q its value of an outcome and
//! A = Q - V, the gradient of `V = sum_o P(o) delta_t(o) Q(o, eta_t / delta_t(o))` is therefore
//!
//! ```text
//! grad V = E[ grad log delta_t(o_t) (A_t - gamma D_{t+1}) ],    D_t = d V(s_t, eta_t) / d log eta_t.
//! ```
//!
//! Without D, the sensitivity to the budget, it is the policy gradient of a game in which budget is
//! free: the antagonist overspends early. D itself follows along a trajectory from the same derivative
//! with log eta_t in the place of a parameter,
//!
//! ```text
//! D_t = gamma D_{t+1} + e_t (A_t - gamma D_{t+1}),    e_t = d log delta_t(o_t) / d log eta_t,
//! ```
//!
//! which is unbiased where A is. In the game `joint` a step has two halves: A_t before the protagonist's draw,
//! with delta_A and eta_t, and O_t before the outcome, with delta_O and eta_t / delta_A(a_t). Each half pays
//! from the budget of the one that follows,
//!
//! ```text
//! D_{O,t} = gamma D_{A,t+1} + e_O (A_O - gamma D_{A,t+1}),    charge of O_t: gamma D_{A,t+1},
//! D_{A,t} = D_{O,t} + e_A (A_A - D_{O,t}),                    charge of A_t: D_{O,t}.
//! ```
//!
//! For the exact worst case D = VaR - CVaR of the remaining return, which
//! is never negative.

/// Step of the forward differences by log eta_t. Backward ones would need a budget below 1.
pub const STEP: f64 = 0.02;

/// Bound of the elasticities: few are larger, but one of them can outweigh a whole minibatch.
pub const LARGEST: f32 = 5.0;

/// The same in the game `joint`, whose protagonist depends on D more closely. Where budget b binds one of two
/// equally likely outcomes, the other one has the elasticity -b/(2-b), and without it D is far too small.
pub const LARGEST_IN_JOINT: f32 = 100.0;

/// What the antagonist's gradient needs of its budget along trajectories.
#[derive(Debug, Clone, PartialEq)]
pub struct BudgetSensitivity {
    /// e_t, shape `[steps, slots]`.
    pub elasticities: Vec<f32>,
    /// D of the states after the last step, by the critic, shape `[slots]`.
    pub last: Vec<f32>,
}

impl BudgetSensitivity {
    /// Subtracts gamma D_{t+1}, what the spent budget is worth, from the advantages.
    pub fn charge(&self, advantages: &mut [f32], ended: &[bool], gamma: f64) {
        let slots = self.last.len();
        let mut later = self.last.clone();
        for row in (0..advantages.len() / slots).rev() {
            for (slot, later) in later.iter_mut().enumerate() {
                let at = row * slots + slot;
                let worth = if ended[at] { 0.0 } else { gamma as f32 * *later };
                advantages[at] -= worth;
                *later = worth + self.elasticities[at] * advantages[at];
            }
        }
    }
}

/// Charges the advantages of both halves of the steps of the game `joint`. The elasticities and the
/// advantages are those of the draw and of the outcome; the game goes on from a draw, after the last step
/// as well, so that what the last outcome leaves is worth `of_draws.last`.
pub fn charge_both(
    (of_draws, by_draws): (&BudgetSensitivity, &mut [f32]),
    (of_outcomes, by_outcomes): (&BudgetSensitivity, &mut [f32]),
    ended: &[bool],
    gamma: f64,
) {
    let slots = of_draws.last.len();
    let mut later = of_draws.last.clone();
    for row in (0..ended.len() / slots).rev() {
        for (slot, later) in later.iter_mut().enumerate() {
            let at = row * slots + slot;
            let worth = if ended[at] { 0.0 } else { gamma as f32 * *later };
            by_outcomes[at] -= worth;
            let worth = worth + of_outcomes.elasticities[at] * by_outcomes[at];
            by_draws[at] -= worth;
            *later = worth + of_draws.elasticities[at] * by_draws[at];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::game::budget::{Budget, Eta};
    use crate::game::finite::FiniteFamily;
    use crate::game::perturbation::{Family, Perturbation};
    use lava_envs::FiniteLaw;

    const STEPS: usize = 3;
    const LAW: FiniteLaw<4> = FiniteLaw { probabilities: [0.55, 0.3, 0.1, 0.05] };
    /// What the antagonist earns by an outcome; the last one ends the episode.
    const REWARDS: [f64; 4] = [-0.2, 0.1, 0.5, 1.0];
    /// Logits a_o + b_o log eta_t, the same at every step: a_1, b_1, a_2, ...
    const PARAMETERS: [f64; 8] = [0.3, -0.1, -0.2, 0.3, 0.4, 0.1, 0.9, -0.2];

    /// One trajectory of the antagonist that these parameters describe.
    #[derive(Clone, Default)]
    struct Path {
        probability: f64,
        rewards: Vec<f64>,
        elasticities: Vec<f64>,
        /// d log delta_t(o_t) / d parameters.
        scores: Vec<[f64; 8]>,
    }

    fn perturbation(
        parameters: &[f64; 8],
        budget: f64,
    ) -> <FiniteFamily<4> as Family>::Perturbation {
        let logits: [f64; 4] =
            std::array::from_fn(|o| parameters[2 * o] + parameters[2 * o + 1] * budget.ln());
        FiniteFamily.perturbation(&logits, &LAW, Budget::start(Eta::new(budget).unwrap()))
    }

    /// All trajectories, with their probabilities.
    fn paths(parameters: &[f64; 8], budget: f64, so_far: &Path, all: &mut Vec<Path>) {
        if so_far.rewards.len() == STEPS || so_far.rewards.last() == Some(&REWARDS[3]) {
            all.push(so_far.clone());
            return;
        }
        let law = perturbation(parameters, budget);
        let richer = perturbation(parameters, budget * 1e-6f64.exp());
        for (outcome, reward) in REWARDS.into_iter().enumerate() {
            let mut by_logits = [0.0; 4];
            let ratio = law.score(outcome, &mut by_logits);
            let score = std::array::from_fn(|i| by_logits[i / 2] * [1.0, budget.ln()][i % 2]);
            let mut path = so_far.clone();
            path.probability *= LAW.probabilities[outcome] * ratio;
            path.rewards.push(reward);
            path.elasticities.push((richer.likelihood_ratio(outcome) / ratio).ln() / 1e-6);
            path.scores.push(score);
            paths(parameters, (budget / ratio).max(1.0), &path, all);
        }
    }

    fn all_paths(parameters: &[f64; 8], budget: f64) -> Vec<Path> {
        let mut all = Vec::new();
        paths(parameters, budget, &Path { probability: 1.0, ..Path::default() }, &mut all);
        all
    }

    /// E[sum_t grad log delta_t A_t], charged or not; the advantage is the remaining return.
    fn gradient(parameters: &[f64; 8], budget: f64, gamma: f64, charged: bool) -> [f64; 8] {
        let mut gradient = [0.0; 8];
        for path in all_paths(parameters, budget) {
            let steps = path.rewards.len();
            let mut advantages = vec![0.0f32; steps];
            let mut later = 0.0;
            for t in (0..steps).rev() {
                later = path.rewards[t] + gamma * later;
                advantages[t] = later as f32;
            }
            if charged {
                let elasticities = path.elasticities.iter().map(|&e| e as f32).collect();
                let sensitivity = BudgetSensitivity { elasticities, last: vec![0.0] };
                let ended: Vec<bool> = (1..=steps).map(|t| t == steps).collect();
                sensitivity.charge(&mut advantages, &ended, gamma);
            }
            let mut discount = path.probability;
            for (score, advantage) in path.scores.iter().zip(advantages) {
                for (sum, score) in gradient.iter_mut().zip(score) {
                    *sum += discount * score * f64::from(advantage);
                }
                discount *= gamma;
            }
        }
        gradient
    }

    /// Over all trajectories of a small game, the charged gradient is the derivative of the game's
    /// exact value; the plain one is not.
    #[test]
    fn the_charged_gradient_is_that_of_the_value() {
        for (budget, gamma) in [(1.3, 1.0), (6.0, 1.0), (6.0, 0.8), (1e6, 1.0)] {
            let value = |parameters: &[f64; 8]| -> f64 {
                let worth = |path: &Path| {
                    path.rewards.iter().rev().fold(0.0, |later, reward| reward + gamma * later)
                };
                all_paths(parameters, budget).iter().map(|p| p.probability * worth(p)).sum()
            };
            let exact: [f64; 8] = std::array::from_fn(|i| {
                let shifted = |by: f64| {
                    let mut parameters = PARAMETERS;
                    parameters[i] += by;
                    value(&parameters)
                };
                (shifted(1e-5) - shifted(-1e-5)) / 2e-5
            });
            let distance = |charged: bool| {
                let gradient = gradient(&PARAMETERS, budget, gamma, charged);
                let off = gradient.iter().zip(exact).map(|(a, b)| (a - b).abs());
                off.fold(0.0, f64::max)
            };
            assert!(distance(true) < 1e-5, "eta = {budget}, gamma = {gamma}: {}", distance(true));
            // Where the budget is ample, more of it is worth almost nothing.
            assert!(budget > 10.0 || distance(false) > 1e-3, "eta = {budget}: {}", distance(false));
        }
    }

    /// The law of the protagonist's draw in the game `joint`.
    const POLICY: FiniteLaw<2> = FiniteLaw { probabilities: [0.7, 0.3] };
    /// What the antagonist earns in addition, by action.
    const BY_ACTION: [f64; 2] = [0.0, 0.3];
    /// The law of the outcome, by action.
    const LAWS: [FiniteLaw<4>; 2] = [LAW, FiniteLaw { probabilities: [0.3, 0.3, 0.3, 0.1] }];
    /// Logits a + b log eta of both halves: four numbers for the draw, then eight for the outcome.
    const BOTH: [f64; 12] = [-0.2, 0.1, 0.3, 0.2, 0.3, -0.1, -0.2, 0.3, 0.4, 0.1, 0.9, -0.2];

    /// One trajectory of the game `joint`.
    #[derive(Clone, Default)]
    struct Joint {
        probability: f64,
        rewards: Vec<f64>,
        /// Of the draw and of the outcome.
        elasticities: [Vec<f32>; 2],
        scores: [Vec<[f64; 12]>; 2],
        over: bool,
    }

    /// Chooses in one half: the probability, the likelihood ratio, its elasticity and the score.
    fn half<const N: usize>(
        parameters: &[f64; 12],
        (at, law): (usize, FiniteLaw<N>),
        budget: f64,
        choice: usize,
    ) -> (f64, f64, f32, [f64; 12]) {
        let of = |budget: f64| {
            let logit =
                |i: usize| parameters[at + 2 * i] + parameters[at + 2 * i + 1] * budget.ln();
            let logits: [f64; N] = std::array::from_fn(logit);
            FiniteFamily.perturbation(&logits, &law, Budget::start(Eta::new(budget).unwrap()))
        };
        let mut by_logits = [0.0; N];
        let ratio = of(budget).score(choice, &mut by_logits);
        let richer = of(budget * 1e-6f64.exp()).likelihood_ratio(choice);
        let mut score = [0.0; 12];
        for (i, by_logit) in by_logits.into_iter().enumerate() {
            (score[at + 2 * i], score[at + 2 * i + 1]) = (by_logit, by_logit * budget.ln());
        }
        let probability = law.probabilities[choice] * ratio;
        (probability, ratio, ((richer / ratio).ln() / 1e-6) as f32, score)
    }

    fn joint_paths(parameters: &[f64; 12], budget: f64, so_far: &Joint, all: &mut Vec<Joint>) {
        if so_far.over || so_far.rewards.len() == STEPS {
            all.push(so_far.clone());
            return;
        }
        for (action, outcome) in (0..2).flat_map(|action| (0..4).map(move |o| (action, o))) {
            let draw = half(parameters, (0, POLICY), budget, action);
            let left = (budget / draw.1).max(1.0);
            let outcomes = half(parameters, (4, LAWS[action]), left, outcome);
            let mut path = so_far.clone();
            for (i, (probability, _, elasticity, score)) in [draw, outcomes].into_iter().enumerate()
            {
                path.probability *= probability;
                path.elasticities[i].push(elasticity);
                path.scores[i].push(score);
            }
            path.rewards.push(REWARDS[outcome] + BY_ACTION[action]);
            path.over = outcome == 3;
            joint_paths(parameters, (left / outcomes.1).max(1.0), &path, all);
        }
    }

    fn all_joint(parameters: &[f64; 12], budget: f64) -> Vec<Joint> {
        let mut all = Vec::new();
        let start = Joint { probability: 1.0, ..Joint::default() };
        joint_paths(parameters, budget, &start, &mut all);
        all
    }

    /// The same for both halves of the game `joint`, around a policy that draws its actions.
    #[test]
    fn the_charged_gradients_of_both_halves_are_those_of_the_value() {
        for (budget, gamma) in [(1.3, 1.0), (6.0, 1.0), (6.0, 0.8)] {
            let value = |parameters: &[f64; 12]| -> f64 {
                let worth = |path: &Joint| {
                    path.rewards.iter().rev().fold(0.0, |later, reward| reward + gamma * later)
                };
                all_joint(parameters, budget).iter().map(|p| p.probability * worth(p)).sum()
            };
            let exact: [f64; 12] = std::array::from_fn(|i| {
                let shifted = |by: f64| {
                    let mut parameters = BOTH;
                    parameters[i] += by;
                    value(&parameters)
                };
                (shifted(1e-5) - shifted(-1e-5)) / 2e-5
            });
            let distance = |charged: bool| {
                let mut gradient = [0.0; 12];
                for path in all_joint(&BOTH, budget) {
                    let steps = path.rewards.len();
                    let mut advantages = [vec![0.0f32; steps], vec![0.0; steps]];
                    let mut later = 0.0;
                    for t in (0..steps).rev() {
                        later = path.rewards[t] + gamma * later;
                        (advantages[0][t], advantages[1][t]) = (later as f32, later as f32);
                    }
                    let [by_draws, by_outcomes] = &mut advantages;
                    if charged {
                        let [draws, outcomes] = path.elasticities.clone().map(|elasticities| {
                            BudgetSensitivity { elasticities, last: vec![0.0] }
                        });
                        let ended: Vec<bool> = (1..=steps).map(|t| t == steps).collect();
                        charge_both((&draws, by_draws), (&outcomes, by_outcomes), &ended, gamma);
                    }
                    for (scores, advantages) in path.scores.iter().zip(&advantages) {
                        let mut discount = path.probability;
                        for (score, advantage) in scores.iter().zip(advantages) {
                            for (sum, score) in gradient.iter_mut().zip(score) {
                                *sum += discount * score * f64::from(*advantage);
                            }
                            discount *= gamma;
                        }
                    }
                }
                gradient.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
            };
            assert!(distance(true) < 1e-5, "eta = {budget}, gamma = {gamma}: {}", distance(true));
            assert!(distance(false) > 1e-3, "eta = {budget}: {}", distance(false));
        }
    }
}
