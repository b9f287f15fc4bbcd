//! The event file against TensorBoard's own reader.

use cvar_game::experiment::tensorboard::{EventFile, FILE};
use std::process::Command;

/// The record of a known event, byte for byte, its checksums as TensorFlow computes them.
#[test]
fn an_event_file_begins_with_its_version() {
    let dir = tempfile::tempdir().unwrap();
    EventFile::create(dir.path(), 0.0).unwrap();
    let bytes = std::fs::read(dir.path().join(FILE)).unwrap();
    let length = [24, 0, 0, 0, 0, 0, 0, 0];
    assert_eq!(bytes[..8], length);
    assert_eq!(bytes[8..12], [0xa3, 0x7f, 0x4b, 0x22]);
    assert_eq!(bytes[12..36], *b"\x09\0\0\0\0\0\0\0\0\x1a\x0dbrain.Event:2");
    assert_eq!(bytes.len(), 40);
}

/// With `pip install tensorboard`; the interpreter may be given in PYTHON.
#[test]
#[ignore = "needs the Python package tensorboard"]
fn tensorboard_reads_what_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut file = EventFile::create(dir.path(), 1000.0).unwrap();
    for step in 1..=3_u64 {
        let scalars = [
            ("protagonist/charts/episodic_return".to_owned(), step as f64 / 4.0),
            ("protagonist/losses/policy_loss".to_owned(), f64::NAN),
        ];
        file.add(1000.0 + step as f64, step * 100_000, &scalars).unwrap();
    }
    let script = "import sys\n\
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator\n\
        events = EventAccumulator(sys.argv[1]); events.Reload()\n\
        for tag in events.Tags()['scalars']:\n\
        \x20   print(tag, [(e.wall_time, e.step, e.value) for e in events.Scalars(tag)])\n";
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let output = Command::new(python).args(["-c", script]).arg(dir.path()).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(
        said.trim(),
        "protagonist/charts/episodic_return \
         [(1001.0, 100000, 0.25), (1002.0, 200000, 0.5), (1003.0, 300000, 0.75)]",
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}
