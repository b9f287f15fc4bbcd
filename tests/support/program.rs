//! What tests of the whole program share.

use assert_cmd::cargo::cargo_bin;
use std::process::{Command, Output, Stdio};

/// The program with a verb, cut off from the terminal. The variable CVAR_GAME_TESTED names another build of
/// it, to see a test fail on a former version.
pub fn program(verb: &str) -> Command {
    let path =
        std::env::var_os("CVAR_GAME_TESTED").map_or_else(|| cargo_bin("cvar-game"), Into::into);
    let mut command = Command::new(path);
    command.arg(verb).stdin(Stdio::null());
    command
}

/// Carries out a command that must succeed.
#[track_caller]
pub fn succeed(command: &mut Command) -> Output {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

/// CSV without its columns of seconds, in which alone two runs of one seed may differ.
pub fn without_timing(text: &str) -> String {
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let header = reader.headers().unwrap().clone();
    let kept: Vec<usize> = (0..header.len()).filter(|&i| !header[i].contains("second")).collect();
    let mut result = String::new();
    for record in std::iter::once(Ok(header)).chain(reader.records()) {
        let record = record.unwrap();
        let row: Vec<&str> = kept.iter().map(|&column| &record[column]).collect();
        result += &(row.join(",") + "\n");
    }
    result
}
