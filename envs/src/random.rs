//! Named streams of random numbers: everything random in a run follows from one seed.

use rand::SeedableRng;
pub use rand::rngs::ChaCha8Rng;

/// What a stream is for. Streams of one seed never overlap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Initial weights of the protagonist.
    ProtagonistWeights,
    /// Initial weights of the antagonist.
    AntagonistWeights,
    /// Actions drawn in training rollouts.
    Actions,
    /// Outcomes of chance drawn in training rollouts.
    Outcomes,
    /// Order of the samples in minibatches.
    Minibatches,
    /// Actions drawn in evaluation, per episode.
    EvaluationActions,
    /// Outcomes of chance drawn in evaluation, per episode.
    EvaluationOutcomes,
    /// Resampling of statistics.
    Bootstrap,
    /// Initial weights of the antagonist of the protagonist's draw.
    ActionAntagonistWeights,
}

/// The stream of `seed` for a purpose; `index` distinguishes the streams of one purpose (for example
/// one per episode) and lies below 2^56.
pub fn stream(seed: u64, purpose: Purpose, index: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    restart(&mut random, purpose, index);
    random
}

/// Makes of a stream the one of the same seed for this purpose and index, from its beginning: [`stream`] in less time.
pub fn restart(random: &mut ChaCha8Rng, purpose: Purpose, index: u64) {
    random.set_stream(((purpose as u64) << 56) | index);
}

/// [`stream`] from a position on that [`position`] reported.
pub fn stream_from(seed: u64, purpose: Purpose, index: u64, position: u128) -> ChaCha8Rng {
    let mut random = stream(seed, purpose, index);
    random.set_word_pos(position);
    random
}

/// How far a stream was read, in 32-bit words.
pub fn position(random: &ChaCha8Rng) -> u128 {
    random.get_word_pos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    #[test]
    fn a_stream_that_is_restarted_is_that_from_the_beginning() {
        let mut random = stream(3, Purpose::Actions, 5);
        for (reads, index) in [(0, 1), (1, 2), (3, 1 << 40), (1_000, 0)] {
            (0..reads).for_each(|_| _ = random.next_u32());
            restart(&mut random, Purpose::Bootstrap, index);
            let mut fresh = stream(3, Purpose::Bootstrap, index);
            (0..200).for_each(|_| assert_eq!(random.next_u64(), fresh.next_u64()));
        }
    }
}
