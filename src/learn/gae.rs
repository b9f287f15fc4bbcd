//! Generalised advantage estimation (Schulman et al. 2016).
//!
//! `A_t = sum_{k>=0} (gamma lambda)^k d_{t+k}`, `d_t = r_t + gamma V(s_{t+1}) - V(s_t)`, within one
//! episode. The end of an episode is a true end, the time limit included: V is 0 after it. Where
//! the rollout ends within an episode, V(s_T) is bootstrapped from the critic.

/// Values and advantages along the trajectories of a rollout.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimates {
    /// V by the critic, shape `[steps + 1, slots]`.
    pub values: Vec<f32>,
    /// Advantages, shape `[steps, slots]`.
    pub advantages: Vec<f32>,
}

/// Writes the advantages. Time-major arrays: `rewards` and `ended` have shape `[steps, slots]`,
/// `values` has one more row, the values of the states after the last step.
pub fn advantages(
    rewards: &[f32],
    ended: &[bool],
    values: &[f32],
    slots: usize,
    gamma: f64,
    lambda: f64,
    advantages: &mut Vec<f32>,
) {
    assert_eq!(values.len(), rewards.len() + slots, "one row of values more than rewards");
    advantages.clear();
    advantages.resize(rewards.len(), 0.0);
    let (gamma, decay) = (gamma as f32, (gamma * lambda) as f32);
    let mut later = vec![0.0; slots];
    for (row, advantages) in advantages.chunks_exact_mut(slots).enumerate().rev() {
        for (slot, advantage) in advantages.iter_mut().enumerate() {
            let at = row * slots + slot;
            let going_on = f32::from(u8::from(!ended[at]));
            let error = rewards[at] + gamma * going_on * values[at + slots] - values[at];
            later[slot] = error + decay * going_on * later[slot];
            *advantage = later[slot];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition, as a double sum in f64.
    fn brute_force(
        rewards: &[f32],
        ended: &[bool],
        values: &[f32],
        slots: usize,
        gamma: f64,
        lambda: f64,
    ) -> Vec<f64> {
        let steps = rewards.len() / slots;
        let at = |t: usize, slot: usize| t * slots + slot;
        let mut out = vec![0.0; rewards.len()];
        for slot in 0..slots {
            for t in 0..steps {
                let mut weight = 1.0;
                for k in t..steps {
                    let i = at(k, slot);
                    let next = if ended[i] { 0.0 } else { f64::from(values[at(k + 1, slot)]) };
                    let error = f64::from(rewards[i]) + gamma * next - f64::from(values[i]);
                    out[at(t, slot)] += weight * error;
                    if ended[i] {
                        break;
                    }
                    weight *= gamma * lambda;
                }
            }
        }
        out
    }

    proptest! {
        #[test]
        fn equals_the_double_sum(
            slots in 1usize..4,
            cells in prop::collection::vec((-1f32..1.0, prop::bool::weighted(0.2), -2f32..2.0), 36),
            last in prop::collection::vec(-2f32..2.0, 3),
            gamma in 0.5f64..=1.0,
            lambda in 0f64..=1.0,
        ) {
            let rewards: Vec<f32> = cells.iter().map(|c| c.0).collect();
            let ended: Vec<bool> = cells.iter().map(|c| c.1).collect();
            let mut values: Vec<f32> = cells.iter().map(|c| c.2).collect();
            values.extend(&last[..slots]);
            let mut fast = Vec::new();
            advantages(&rewards, &ended, &values, slots, gamma, lambda, &mut fast);
            let slow = brute_force(&rewards, &ended, &values, slots, gamma, lambda);
            for (fast, slow) in fast.iter().zip(slow) {
                prop_assert!((f64::from(*fast) - slow).abs() < 1e-4, "{fast} against {slow}");
            }
        }
    }
}
