//! A sweep as a Slurm job array: one task per run, then a job that writes the tables.
//!
//! | file in `OUT/slurm/` | what |
//! |---|---|
//! | `config.toml` | the resolved configuration: later changes of the user's file do not matter |
//! | `runs.txt` | the runs, one per line |
//! | `array.sh` | the task: carries out one line of `runs.txt` |
//! | `table.sh` | the job that runs after them |
//! | `submit.sh` | submits both |
//!
//! A minute before its time limit a task gets SIGTERM; it writes a checkpoint, exits with
//! [`RESUME`] and is put into the queue again.

use super::config::Config;
use super::names::RunId;
use super::stop::RESUME;
use crate::files::write_in_place;
use std::fmt::Write as _;
use std::io;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Tasks of one array: Slurm's default MaxArraySize admits indices up to 1000.
const LARGEST_ARRAY: usize = 1000;

/// The user's options for Slurm.
#[derive(Debug, Clone, Default)]
pub struct SlurmOptions {
    /// Time limit of a task.
    pub time: Option<String>,
    /// Partition.
    pub partition: Option<String>,
    /// Most tasks at a time.
    pub array_limit: Option<NonZeroUsize>,
    /// Further options of sbatch.
    pub extra: Vec<String>,
}

/// Writes the scripts of a sweep into `out`; `program` carries out the runs. Returns the path of
/// `submit.sh`.
///
/// # Errors
/// If the folder cannot be written.
pub fn write(
    config: &Config,
    runs: &[RunId],
    out: &Path,
    program: &Path,
    options: &SlurmOptions,
) -> io::Result<PathBuf> {
    let out = std::path::absolute(out)?;
    let folder = out.join("slurm");
    std::fs::create_dir_all(&folder)?;
    let quoted = |path: &Path| quoted(&path.to_string_lossy());
    let [config_file, runs_file, array, table, submit] =
        ["config.toml", "runs.txt", "array.sh", "table.sh", "submit.sh"]
            .map(|name| folder.join(name));
    let (program, results) = (quoted(program), quoted(&out));

    let list: String = runs.iter().map(|run| format!("{run}\n")).collect();
    let task = format!(
        r#"#!/bin/bash
# One run of the sweep; FIRST is the line of the run of task 0, from 0.
#SBATCH --job-name=cvar-game
#SBATCH --cpus-per-task=1
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@60
run=$(sed -n "$((FIRST + SLURM_ARRAY_TASK_ID + 1))p" {runs_file})
{program} bench --config {config_file} --out {results} --jobs 1 --only "$run" &
program=$!
trap 'kill -TERM "$program"' TERM
wait "$program"
code=$?
# The first wait ends with the signal, the program after it.
while kill -0 "$program" 2>/dev/null; do
    wait "$program"
    code=$?
done
# {RESUME}: stopped and intact. A task that was cancelled is no longer RUNNING and stays away.
if [ "$code" -eq {RESUME} ] && [ "$(squeue -h -j "$SLURM_JOB_ID" -o %T)" = RUNNING ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
"#,
        runs_file = quoted(&runs_file),
        config_file = quoted(&config_file),
    );
    let after = format!(
        "#!/bin/bash\n#SBATCH --job-name=cvar-game-table\n#SBATCH --cpus-per-task=1\n\
         {program} report {results}\n"
    );

    write_in_place(&config_file, config.to_toml().as_bytes())?;
    write_in_place(&runs_file, list.as_bytes())?;
    write_in_place(&array, task.as_bytes())?;
    write_in_place(&table, after.as_bytes())?;
    let text = submission(runs.len(), &folder, [&quoted(&array), &quoted(&table)], options);
    write_in_place(&submit, text.as_bytes())?;
    Ok(submit)
}

/// The text of `submit.sh`.
fn submission(
    runs: usize,
    folder: &Path,
    [array, table]: [&str; 2],
    options: &SlurmOptions,
) -> String {
    let flags = |time: bool| {
        let time = options.time.iter().filter(|_| time).map(|time| format!("--time={time}"));
        let partition =
            options.partition.iter().map(|partition| format!("--partition={partition}"));
        let all = time.chain(partition).chain(options.extra.iter().cloned());
        all.map(|option| format!(" {}", quoted(&option))).collect::<String>()
    };
    // sbatch replaces patterns such as %A, so a `%` of the folder is doubled.
    let folder = folder.to_string_lossy().replace('%', "%%");
    let log = |name: &str| quoted(&format!("--output={folder}/{name}"));
    let limit = options.array_limit.map_or(String::new(), |limit| format!("%{limit}"));
    let mut text = "#!/bin/sh\n# Submits the sweep.\nset -eu\nafter=\n".to_owned();
    for first in (0..runs).step_by(LARGEST_ARRAY) {
        let last = (runs - first).min(LARGEST_ARRAY) - 1;
        let logs = log("%A_%a.log");
        let _ = writeln!(
            text,
            "id=$(sbatch --parsable --array=0-{last}{limit} --export=ALL,FIRST={first} \
             {logs}{} {array})\nafter=$after:${{id%%;*}}",
            flags(true)
        );
    }
    let logs = log("table.log");
    // Also after failed tasks: the table counts them.
    let _ = writeln!(
        text,
        "table=$(sbatch --parsable --dependency=\"afterany$after\" {logs}{} {table})\n\
         echo \"submitted as jobs ${{after#:}}, the table as job ${{table%%;*}}\"",
        flags(false)
    );
    text
}

/// A text as one word of the shell.
pub fn quoted(word: &str) -> String {
    let quoter = shlex::Quoter::new().allow_nul(true);
    quoter.quote(word).expect("only NUL can be refused").into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_stay_words_in_the_shell() {
        for word in ["plain", "with space", "it's", "$HOME `id`", "a\nb", "\\", "--time=1:00"] {
            let script = format!("printf %s {}", quoted(word));
            let output = std::process::Command::new("sh").args(["-c", &script]).output().unwrap();
            assert_eq!(String::from_utf8(output.stdout).unwrap(), word);
        }
    }

    #[test]
    fn a_long_sweep_becomes_several_arrays_that_cover_it() {
        let options = SlurmOptions { array_limit: NonZeroUsize::new(8), ..SlurmOptions::default() };
        let text =
            submission(2_001, Path::new("/out/slurm"), ["'array.sh'", "'table.sh'"], &options);
        for part in [
            "--array=0-999%8 --export=ALL,FIRST=0 ",
            "--array=0-999%8 --export=ALL,FIRST=1000 ",
            "--array=0-0%8 --export=ALL,FIRST=2000 ",
        ] {
            assert_eq!(text.matches(part).count(), 1, "{text}");
        }
        assert_eq!(text.matches("'table.sh'").count(), 1, "{text}");
    }
}
