//! A sweep on a real Slurm: munged, slurmctld and slurmd on this machine alone.
//!
//! Needs root and the packages slurm-wlm and munge. `cargo test --test slurm -- --ignored`
#![cfg(unix)]

#[path = "support/program.rs"]
mod support;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use support::{program, succeed, without_timing};
use tempfile::TempDir;

/// The variable that tells Slurm's programs where their configuration is.
const SETTINGS: &str = "SLURM_CONF";

/// Daemons in a folder of their own; they end with it.
struct Cluster {
    folder: TempDir,
    daemons: Vec<Child>,
}

impl Drop for Cluster {
    fn drop(&mut self) {
        // Slurm before munge.
        for daemon in self.daemons.iter_mut().rev() {
            let _ = Command::new("kill").arg(daemon.id().to_string()).status();
            let _ = daemon.wait();
        }
    }
}

impl Cluster {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut cluster = Cluster { folder, daemons: Vec::new() };
        let key: Vec<u8> = (0..128).collect(); // guards a cluster of one machine for a minute
        fs::write(cluster.path("munge.key"), key).unwrap();
        let private = fs::Permissions::from_mode(0o600);
        fs::set_permissions(cluster.path("munge.key"), private).unwrap();
        for name in ["state", "spool"] {
            fs::create_dir(cluster.path(name)).unwrap();
        }
        fs::write(cluster.path("slurm.conf"), cluster.configuration()).unwrap();

        let root = cluster.folder.path().to_owned();
        let path = |name: &str| root.join(name).to_str().unwrap().to_owned();
        let munge = [
            "--foreground".to_owned(),
            "--force".to_owned(),
            format!("--socket={}", path("munge.socket")),
            format!("--key-file={}", path("munge.key")),
            format!("--pid-file={}", path("munge.pid")),
            format!("--log-file={}", path("munge.log")),
            format!("--seed-file={}", path("munge.seed")),
        ];
        let munged = cluster.daemon("munged", &munge);
        cluster.daemons.push(munged);
        cluster.until("munge", || cluster.path("munge.socket").exists());
        let configuration = ["-D".to_owned(), "-f".to_owned(), path("slurm.conf")];
        for program in ["slurmctld", "slurmd"] {
            let daemon = cluster.daemon(program, &configuration);
            cluster.daemons.push(daemon);
        }
        cluster.until("an idle node", || cluster.ask("sinfo", &["-h", "-o", "%T"]) == "idle\n");
        cluster
    }

    fn configuration(&self) -> String {
        let name = fs::read_to_string("/proc/sys/kernel/hostname").unwrap();
        let name = name.trim();
        let [controller, node] = [free_port(), free_port()];
        let cores = std::thread::available_parallelism().unwrap();
        let path = |file: &str| self.path(file).display().to_string();
        // A requeued task waits until its old credential has expired, by default two minutes.
        format!(
            "ClusterName=drill\nSlurmctldHost={name}(127.0.0.1)\nSlurmUser=root\nSlurmdUser=root\n\
             AuthType=auth/munge\nAuthInfo=socket={},cred_expire=5\nCryptoType=crypto/munge\n\
             ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\n\
             SelectType=select/cons_tres\nSelectTypeParameters=CR_CPU\n\
             SlurmctldPort={controller}\nSlurmdPort={node}\nReturnToService=2\nMpiDefault=none\n\
             StateSaveLocation={}\nSlurmdSpoolDir={}\nSlurmctldPidFile={}\nSlurmdPidFile={}\n\
             SlurmctldLogFile={}\nSlurmdLogFile={}\nSchedulerParameters=bf_interval=1,sched_interval=1\n\
             NodeName={name} NodeAddr=127.0.0.1 CPUs={cores} State=UNKNOWN\n\
             PartitionName=only Nodes={name} Default=YES State=UP\n",
            path("munge.socket"),
            path("state"),
            path("spool"),
            path("slurmctld.pid"),
            path("slurmd.pid"),
            path("slurmctld.log"),
            path("slurmd.log"),
        )
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command.env(SETTINGS, self.path("slurm.conf")).stdin(Stdio::null());
        command
    }

    fn daemon(&self, program: &str, arguments: &[String]) -> Child {
        let log = fs::File::create(self.path(&format!("{program}.out"))).unwrap();
        let mut command = self.command(Path::new("/usr/sbin").join(program));
        command.args(arguments).stdout(log.try_clone().unwrap()).stderr(log);
        command.spawn().unwrap_or_else(|error| panic!("{program}: {error}; is slurm-wlm there?"))
    }

    fn ask(&self, program: &str, arguments: &[&str]) -> String {
        let output = self.command(program).args(arguments).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    }

    fn until(&self, what: &str, condition: impl Fn() -> bool) {
        self.within(Duration::from_secs(120), what, condition);
    }

    fn within(&self, patience: Duration, what: &str, condition: impl Fn() -> bool) {
        let start = Instant::now();
        while !condition() {
            if start.elapsed() > patience {
                for log in ["munged.out", "slurmctld.log", "slurmd.log"] {
                    let text = fs::read_to_string(self.path(log)).unwrap_or_default();
                    eprintln!("--- {log}\n{text}");
                }
                panic!("waited in vain for {what}");
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }
}

fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

const CONFIG: &str = r#"
[experiment]
etas = [1, 25]
seeds = [1, 2]
[train]
steps = 600_000
[checkpoint]
every = 5
[evaluation]
episodes = 500
figure_episodes = 500
"#;

fn table(out: &Path) -> String {
    without_timing(&fs::read_to_string(out.join("table.csv")).unwrap())
}

/// A sweep in a folder of the cluster's, once as a job array and once by `bench`.
struct Sweep<'a> {
    cluster: &'a Cluster,
    config: PathBuf,
    out: PathBuf,
    expected: PathBuf,
}

impl<'a> Sweep<'a> {
    fn new(cluster: &'a Cluster, config: &str) -> Self {
        // A name that a careless script would take apart.
        let folder = cluster.path("the user's 100% folder");
        fs::create_dir(&folder).unwrap();
        let path = folder.join("drill.toml");
        fs::write(&path, config).unwrap();
        let (out, expected) = (folder.join("out"), folder.join("expected"));
        Sweep { cluster, config: path, out, expected }
    }

    fn program(&self, verb: &str, out: &Path) -> Command {
        let mut command = program(verb);
        command.arg("--config").arg(&self.config).arg("--out").arg(out);
        command.env(SETTINGS, self.cluster.path("slurm.conf"));
        command
    }

    /// Submits the array; the number of its job.
    fn submit(&self) -> String {
        let mut command = self.program("slurm", &self.out);
        let submitted = succeed(command.args(["--array-limit", "2", "--submit"]));
        let told = String::from_utf8(submitted.stdout).unwrap();
        told.split_whitespace().nth(3).unwrap().trim_end_matches(',').to_owned()
    }

    /// The folder of the run of this task.
    fn folder(&self, task: usize) -> PathBuf {
        let runs = fs::read_to_string(self.out.join("slurm/runs.txt")).unwrap();
        self.out.join(runs.lines().nth(task).unwrap())
    }

    /// What the task of this name has said so far.
    fn log(&self, task: &str) -> String {
        fs::read_to_string(self.out.join(format!("slurm/{task}.log"))).unwrap_or_default()
    }

    /// The array ends in the table of `bench`, which is carried out here, and in the page.
    fn assert_ends_as_bench(&self, patience: Duration) {
        let cluster = self.cluster;
        let ended = || cluster.ask("squeue", &["-h"]).is_empty();
        cluster.within(patience, "the end of all jobs", ended);
        let made = fs::read_to_string(self.out.join("slurm/table.log")).unwrap();
        assert!(made.contains("report.html"), "{made}");
        let page = fs::read_to_string(self.out.join("report.html")).unwrap();
        assert!(page.contains("lava-point") && page.trim_end().ends_with("</html>"));
        succeed(&mut self.program("bench", &self.expected));
        assert_eq!(table(&self.out), table(&self.expected));
        // Nothing is left to submit.
        let again = succeed(self.program("slurm", &self.out).arg("--submit"));
        assert!(String::from_utf8(again.stdout).unwrap().starts_with("all runs are finished"));
    }
}

#[test]
#[ignore = "needs root, slurm-wlm and munge"]
fn an_array_with_a_task_that_is_stopped_and_requeued_ends_in_the_table_of_bench() {
    let cluster = Cluster::start();
    let sweep = Sweep::new(&cluster, CONFIG);
    let task = format!("{}_0", sweep.submit());
    let checkpoint = sweep.folder(0).join("checkpoint-5.bin");
    cluster.until("a checkpoint", || checkpoint.exists());
    // It repeats itself; a second signal could reach the requeued task before it is ready for one.
    let mut scancel = cluster.command("scancel");
    let mut scancel = scancel.args(["--batch", "--signal=TERM", &task]).spawn().unwrap();
    cluster.until("the task's stop", || sweep.log(&task).contains("the same command goes on"));
    let _ = scancel.kill();
    scancel.wait().unwrap();
    cluster.until("the requeued task", || sweep.log(&task).contains("continues after update"));
    sweep.assert_ends_as_bench(Duration::from_secs(120));
}

/// With release binaries minutes of two cores. `DRILL_CONFIG` may name another sweep than the quick one.
#[test]
#[ignore = "needs root, slurm-wlm and munge, and takes minutes"]
fn the_quick_sweep_with_a_task_that_is_killed_and_requeued_ends_in_the_table_of_bench() {
    let quick = || {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
        configs.map(|at| at.join("configs/quick.toml")).find(|path| path.exists()).unwrap()
    };
    let config = std::env::var_os("DRILL_CONFIG").map_or_else(quick, PathBuf::from);
    let config = fs::read_to_string(config).unwrap() + "\n[checkpoint]\nevery = 10\n";
    let cluster = Cluster::start();
    let sweep = Sweep::new(&cluster, &config);
    let task = format!("{}_0", sweep.submit());
    let checkpoint = sweep.folder(0).join("checkpoint-10.bin");
    cluster.until("a checkpoint", || checkpoint.exists());
    // Slurm itself would ask before it kills; the program and its worker have no time to save anything.
    let cluster_name = cluster.folder.path().file_name().unwrap().to_str().unwrap();
    let run = sweep.folder(0).strip_prefix(&sweep.out).unwrap().display().to_string();
    let processes = format!("{cluster_name}/.*{run}");
    succeed(Command::new("pkill").args(["-KILL", "-f", &processes]));
    let state = || cluster.ask("squeue", &["-h", "-j", &task, "-o", "%T"]);
    cluster.until("the task's end", || !["RUNNING\n", "COMPLETING\n"].contains(&&*state()));
    assert!(!sweep.log(&task).contains("the same command goes on"), "{}", sweep.log(&task));
    assert!(!sweep.folder(0).join("evaluation.json").exists());
    succeed(cluster.command("scontrol").args(["requeue", &task]));
    // It stands in the queue behind all others.
    let patience = Duration::from_secs(3600);
    let resumed = || sweep.log(&task).contains("continues after update");
    cluster.within(patience, "the requeued task", resumed);
    sweep.assert_ends_as_bench(patience);
}
