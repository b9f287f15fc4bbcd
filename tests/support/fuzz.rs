//! Fuzzing of parsers with proptest: arbitrary bytes, and valid files with random damage.
//!
//! `cargo test` looks at a few hundred inputs each;
//!
//! ```text
//! FUZZ_MINUTES=10 cargo test --workspace hostile -- --ignored --nocapture
//! ```
//!
//! goes on for 10 minutes per parser. An input that fails is shrunk and told; keep it in
//! `tests/corpus/PARSER/`, whose files are inputs of every run.

use proptest::prelude::*;
use proptest::test_runner::{Config as Proptest, RngAlgorithm, TestRng, TestRunner};
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

/// One change of a valid file.
#[derive(Debug, Clone)]
enum Damage {
    Set(usize, u8),
    Insert(usize, Vec<u8>),
    Remove(usize, usize),
    Repeat(usize, usize, usize),
}

impl Damage {
    fn apply(&self, bytes: &mut Vec<u8>) {
        let place = |at: usize| at % (bytes.len() + 1);
        match self {
            Damage::Set(at, byte) => {
                let at = place(*at);
                if let Some(there) = bytes.get_mut(at) {
                    *there = *byte;
                }
            }
            Damage::Insert(at, new) => {
                let at = place(*at);
                bytes.splice(at..at, new.iter().copied());
            }
            Damage::Remove(at, count) => {
                let at = place(*at);
                bytes.drain(at..(at + count).min(bytes.len()));
            }
            Damage::Repeat(at, count, times) => {
                let at = place(*at);
                let piece = bytes[at..(at + count).min(bytes.len())].repeat(*times);
                bytes.splice(at..at, piece);
            }
        }
    }
}

fn damage() -> impl Strategy<Value = Damage> {
    let at = 0..1_000_000usize;
    // What numbers, structures and paths go wrong with.
    let words = prop::sample::select(vec![
        "1e999",
        "-1",
        "0",
        "nan",
        "inf",
        "null",
        "9223372036854775807",
        "4294967296",
        "1e-320",
        "\"",
        "[",
        "{",
        "[[[[[[[[[[[[[[[[",
        "a.a.a.a.a.a.a.a.",
        "../../../etc/",
        "\0",
        "\n",
        "S",
        "L",
        "\u{1F525}",
        "_",
        "true",
    ]);
    let new = prop_oneof![
        prop::collection::vec(any::<u8>(), 1..9),
        words.prop_map(|word| word.as_bytes().to_vec()),
    ];
    prop_oneof![
        4 => (at.clone(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        4 => (at.clone(), new).prop_map(|(at, new)| Damage::Insert(at, new)),
        2 => (at.clone(), 1..40usize).prop_map(|(at, count)| Damage::Remove(at, count)),
        1 => (at, 1..60usize, 2..200usize)
            .prop_map(|(at, count, times)| Damage::Repeat(at, count, times)),
    ]
}

/// Arbitrary bytes, and damaged ones of valid files and of the files in `tests/corpus/CORPUS`.
pub fn inputs(mut valid: Vec<Vec<u8>>, corpus: &str) -> BoxedStrategy<Vec<u8>> {
    // The crates that this module is part of lie in different places.
    let corpora = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let folder = corpora.map(|at| at.join("tests/corpus").join(corpus)).find(|at| at.is_dir());
    for entry in folder.iter().flat_map(|folder| fs::read_dir(folder).unwrap()) {
        valid.push(fs::read(entry.unwrap().path()).unwrap());
    }
    let damaged = (prop::sample::select(valid), prop::collection::vec(damage(), 0..6)).prop_map(
        |(mut bytes, damages)| {
            damages.iter().for_each(|damage| damage.apply(&mut bytes));
            bytes
        },
    );
    prop_oneof![1 => prop::collection::vec(any::<u8>(), 0..600), 7 => damaged].boxed()
}

/// Feeds a parser for a while; the number of inputs.
pub fn fuzz(
    inputs: &BoxedStrategy<Vec<u8>>,
    (cases, time): (u32, Duration),
    parser: impl Fn(&[u8]),
) -> u64 {
    let start = Instant::now();
    let mut count = 0;
    loop {
        let config = Proptest { cases, failure_persistence: None, ..Proptest::default() };
        // Another seed each time round; the same ones in every run.
        let mut seed = [7; 32];
        seed[..8].copy_from_slice(&u64::to_le_bytes(count));
        let random = TestRng::from_seed(RngAlgorithm::ChaCha, &seed);
        let result = TestRunner::new_with_rng(config, random).run(inputs, |bytes| {
            parser(&bytes);
            Ok(())
        });
        if let Err(error) = result {
            panic!("{error}");
        }
        count += u64::from(cases);
        if start.elapsed() >= time {
            return count;
        }
    }
}

/// How long to look: shortly ...
pub fn shortly() -> (u32, Duration) {
    (400, Duration::ZERO)
}

/// ... or for `FUZZ_MINUTES`.
pub fn for_minutes() -> (u32, Duration) {
    let minutes = std::env::var("FUZZ_MINUTES").map_or(1.0, |text| text.parse().unwrap());
    (2_000, Duration::from_secs_f64(60.0 * minutes))
}

/// Two tests for each parser, a function from effort to number of inputs.
macro_rules! fuzz_targets {
    ($($name:ident),*) => {
        $(mod $name {
            #[test]
            fn no_input_harms() {
                super::$name(crate::fuzz::shortly());
            }
            #[test]
            #[ignore = "FUZZ_MINUTES per parser"]
            fn no_input_harms_for_minutes() {
                let count = super::$name(crate::fuzz::for_minutes());
                eprintln!("{}: {count} inputs", stringify!($name));
            }
        })*
    };
}

pub(crate) use fuzz_targets;
