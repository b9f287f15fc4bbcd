//! The replay: the last steps of the protagonist, in a ring.

use crate::learn::inputs::{Inputs, Rows};
use serde::{Deserialize, Serialize};

/// A step of an episode.
#[derive(Debug, Clone, Copy)]
pub struct Transition<'a> {
    /// What was seen before it.
    pub seen: Rows<'a>,
    /// Index of the action.
    pub action: u32,
    /// Reward.
    pub reward: f32,
    /// Whether the episode ended with it.
    pub ended: bool,
    /// What was seen after it.
    pub next: Rows<'a>,
}

/// Some steps, columns of a minibatch.
#[derive(Debug, Default)]
pub struct Minibatch {
    pub seen: Inputs,
    pub actions: Vec<i64>,
    pub rewards: Vec<f32>,
    pub ended: Vec<bool>,
    pub next: Inputs,
}

/// The last steps.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Replay {
    capacity: usize,
    /// Length of a sample's numbers.
    width: usize,
    /// Where the next step goes once the ring is full.
    oldest: usize,
    seen: Inputs,
    actions: Vec<u32>,
    rewards: Vec<f32>,
    ended: Vec<bool>,
    next: Inputs,
}

impl Replay {
    /// An empty replay of samples with so many numbers.
    pub fn new(capacity: usize, width: usize) -> Self {
        let (seen, next) = (Inputs::default(), Inputs::default());
        let (actions, rewards, ended) = (Vec::new(), Vec::new(), Vec::new());
        Replay { capacity, width, oldest: 0, seen, actions, rewards, ended, next }
    }

    /// Number of steps.
    pub fn len(&self) -> usize {
        self.actions.len()
    }

    /// Whether this is a replay as [`Replay::new`] makes it, of samples with cells or without, for actions below `actions`.
    pub fn fits(&self, like: &Replay, cells: usize, actions: usize) -> bool {
        let steps = self.len();
        let rows = |of: &Inputs| {
            of.numbers.len() == steps * self.width
                && of.cells.len() == if cells == 0 { 0 } else { steps }
                && of.cells.iter().all(|&cell| (cell as usize) < cells)
        };
        (self.capacity, self.width) == (like.capacity, like.width)
            && steps <= self.capacity
            && self.oldest < self.capacity
            && [self.rewards.len(), self.ended.len()] == [steps; 2]
            && self.actions.iter().all(|&action| (action as usize) < actions)
            && rows(&self.seen)
            && rows(&self.next)
    }

    /// Adds a step, in place of the oldest once the replay is full.
    pub fn add(&mut self, step: Transition<'_>) {
        if self.len() < self.capacity {
            self.seen.extend(step.seen);
            self.actions.push(step.action);
            self.rewards.push(step.reward);
            self.ended.push(step.ended);
            self.next.extend(step.next);
            return;
        }
        let (at, width) = (self.oldest, self.width);
        for (kept, new) in [(&mut self.seen, step.seen), (&mut self.next, step.next)] {
            if let (Some(cell), Some(&new)) = (kept.cells.get_mut(at), new.cells.first()) {
                *cell = new;
            }
            kept.numbers[at * width..][..width].copy_from_slice(new.numbers);
        }
        (self.actions[at], self.rewards[at], self.ended[at]) =
            (step.action, step.reward, step.ended);
        self.oldest = (at + 1) % self.capacity;
    }

    /// The steps of these indices.
    pub fn gather(&self, indices: impl Iterator<Item = usize>, into: &mut Minibatch) {
        into.seen.clear();
        into.next.clear();
        into.actions.clear();
        into.rewards.clear();
        into.ended.clear();
        for index in indices {
            into.seen.extend(self.seen.rows().row(index, self.width));
            into.next.extend(self.next.rows().row(index, self.width));
            into.actions.push(i64::from(self.actions[index]));
            into.rewards.push(self.rewards[index]);
            into.ended.push(self.ended[index]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(number: u32) -> Inputs {
        Inputs { cells: vec![number], numbers: vec![number as f32, 1.0] }
    }

    #[test]
    fn a_full_replay_holds_the_last_steps() {
        let mut replay = Replay::new(3, 2);
        for number in 0..8 {
            let (seen, next) = (step(number), step(number + 1));
            let (action, reward, ended) = (number % 2, number as f32, number == 7);
            replay.add(Transition { seen: seen.rows(), action, reward, ended, next: next.rows() });
            assert!(replay.fits(&Replay::new(3, 2), 9, 2));
        }
        let mut minibatch = Minibatch::default();
        replay.gather(0..3, &mut minibatch);
        let mut held: Vec<u32> = minibatch.seen.cells.clone();
        held.sort_unstable();
        assert_eq!(held, [5, 6, 7]);
        for (i, &cell) in minibatch.seen.cells.iter().enumerate() {
            assert_eq!(minibatch.next.cells[i], cell + 1);
            assert_eq!(minibatch.seen.numbers[2 * i..][..2], [cell as f32, 1.0]);
            assert_eq!(minibatch.next.numbers[2 * i..][..2], [cell as f32 + 1.0, 1.0]);
            assert_eq!(minibatch.rewards[i], cell as f32);
            assert_eq!(minibatch.actions[i], i64::from(cell % 2));
            assert_eq!(minibatch.ended[i], cell == 7);
        }
    }
}
