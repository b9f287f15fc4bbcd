//! The oracle of lava-point: over noise and control steps, as a table of what it certifies and how it checks, and its
//! certificates on every scene, which come with the program.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use serde_json::Value;

/// Standard deviations of the noise in m/s.
const NOISES: [f64; 9] = [0.05, 0.1, 0.3, 0.5, 0.6, 1.0, 1.5, 2.0, 3.0];

/// Control steps in s.
const CONTROL_STEPS: [f64; 5] = [0.05, 0.1, 0.2, 0.3, 0.5];

/// Budget.
const ETA: u32 = 25;

/// What a row of the table says.
struct Row {
    noise: f64,
    control_step: f64,
    certified: f64,
    half_width: f64,
    script: (String, f64),
    own: f64,
    error: f64,
    lattice: String,
    seconds: f64,
}

impl Row {
    fn new(noise: f64, control_step: f64, answer: &Value) -> Result<Row> {
        let number = |value: &Value, name: &str| {
            value[name].as_f64().with_context(|| format!("the answer has no {name}"))
        };
        let scripts = answer["baselines"].as_array().context("the answer has no baselines")?;
        let mut best = (String::new(), f64::NEG_INFINITY);
        for script in scripts {
            let cvar = number(script, "cvar")?;
            if cvar > best.1 {
                best = (script["name"].as_str().unwrap_or_default().to_owned(), cvar);
            }
        }
        let nodes: Vec<String> = answer["lattice_nodes"]
            .as_array()
            .into_iter()
            .flatten()
            .map(Value::to_string)
            .collect();
        let lattice = &answer["lattice"];
        Ok(Row {
            noise,
            control_step,
            certified: number(answer, "certified_cvar")?,
            half_width: (number(answer, "certified_cvar_hi")?
                - number(answer, "certified_cvar_lo")?)
                / 2.0,
            script: best,
            own: number(answer, "lattice_value")?,
            error: number(answer, "lattice_error")?,
            lattice: format!(
                "{} ({} m, {:.2} m/s)",
                nodes.join(" x "),
                number(lattice, "cell")?,
                number(lattice, "velocity")?
            ),
            seconds: number(answer, "seconds")?,
        })
    }

    /// Whether the certified value is at least the best script's, and the lattice's own value is within its
    /// error and three standard errors of it.
    fn agrees(&self) -> [bool; 2] {
        let apart = (self.own - self.certified).abs();
        [self.certified >= self.script.1, apart <= self.error + 1.5 * self.half_width]
    }
}

/// Asks a built program for every world of the table, and writes it to `results/oracle`.
pub fn measure(repository: &Path, target: &Path) -> Result<()> {
    let program = target.join("release").join("cvar-game");
    let mut rows = Vec::new();
    for control_step in CONTROL_STEPS {
        for noise in NOISES {
            let output = Command::new(&program)
                .args(["exact", "--env", "lava-point", "--json", "--anew", "--eta"])
                .arg(ETA.to_string())
                .arg("--set")
                .arg(format!("env.noise={noise}"))
                .arg("--set")
                .arg(format!("env.control_step={control_step}"))
                .output()
                .with_context(|| format!("{} cannot be started", program.display()))?;
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            ensure!(output.status.success(), "noise {noise}, control step {control_step}: {said}");
            let row = Row::new(noise, control_step, &serde_json::from_slice(&output.stdout)?)?;
            println!("{}", line(&row));
            rows.push(row);
        }
    }
    let folder = repository.join("results").join("oracle");
    fs::create_dir_all(&folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    for (name, text) in [("oracle.md", page(&rows)), ("oracle.csv", csv(&rows))] {
        let path = folder.join(name);
        fs::write(&path, text).with_context(|| format!("{} cannot be written", path.display()))?;
    }
    Ok(())
}

/// Budgets of the certificates on scenes.
const ETAS: [u32; 3] = [1, 25, 100];

/// Adds the certificates of lava-point on every scene to `configs/oracle.json`, and the upper bounds to
/// `configs/upper-bounds.json`. Each is kept as soon as it is known.
pub fn certify(repository: &Path, target: &Path) -> Result<()> {
    let program = target.join("release").join("cvar-game");
    let cache = target.join("certificates");
    let ask = |arguments: &[&str]| -> Result<Value> {
        let output = Command::new(&program)
            .args(arguments)
            .arg("--json")
            .env("XDG_CACHE_HOME", &cache)
            .output()
            .with_context(|| format!("{} cannot be started", program.display()))?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure!(output.status.success(), "{}: {said}", arguments.join(" "));
        Ok(serde_json::from_slice(&output.stdout)?)
    };
    let worlds = ask(&["envs"])?;
    let worlds = worlds.as_object().context("`envs` answers with no worlds")?;
    for world in worlds.keys().filter(|world| world.starts_with("lava-point/")) {
        for eta in ETAS {
            let answer = ask(&["exact", "--env", world, "--eta", &eta.to_string()])?;
            let number = |name: &str| answer[name].as_f64().unwrap_or(f64::NAN);
            println!(
                "{world}, eta {eta}: {:.4} in [{:.4}, {:.4}], lattice {:.4} +- {:.4}, {:.0} s",
                number("certified_cvar"),
                number("certified_cvar_lo"),
                number("certified_cvar_hi"),
                number("lattice_value"),
                number("lattice_error"),
                number("seconds"),
            );
        }
    }
    let mut found: Vec<_> = match fs::read_dir(cache.join("cvar-game").join("oracle")) {
        Ok(files) => files.map(|file| Ok(file?.path())).collect::<Result<_>>()?,
        Err(_) => Vec::new(),
    };
    found.sort();
    let (mut certificates, mut bounds) = (Vec::new(), Vec::new());
    for file in found {
        let text = fs::read_to_string(file)?.trim().to_owned();
        let entry: Value = serde_json::from_str(&text)?;
        if entry["certified"].get("shortfalls").is_some() {
            // The side of its cells ends the key of a bound in the cache.
            let cell = format!(" {}\",\"certified\":", entry["certified"]["cell"]);
            bounds.push(text.replacen(&cell, "\",\"certified\":", 1));
        } else {
            certificates.push(text);
        }
    }
    let configs = repository.join("configs");
    add(&configs.join("oracle.json"), certificates)?;
    add(&configs.join("upper-bounds.json"), bounds)
}

/// Adds entries to a file that has one on each line, as the files of the cache have them.
fn add(path: &Path, found: Vec<String>) -> Result<()> {
    let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let mut entries: Vec<String> = (text.lines().filter(|line| line.starts_with('{')))
        .map(|line| line.trim_end_matches(',').to_owned())
        .collect();
    for entry in found {
        if !entries.contains(&entry) {
            entries.push(entry);
        }
    }
    fs::write(path, format!("[\n{}\n]\n", entries.join(",\n")))
        .with_context(|| format!("{} cannot be written", path.display()))
}

fn line(row: &Row) -> String {
    let Row { noise, control_step, certified, half_width, script, own, error, lattice, seconds } =
        row;
    format!(
        "| {control_step} | {noise} | {certified:.4} +- {half_width:.4} | {:.4} ({}) | {own:.4} +- {error:.4} | {lattice} | \
         {seconds:.0} |",
        script.1, script.0
    )
}

fn page(rows: &[Row]) -> String {
    let mut text = format!(
        "# The oracle of lava-point over noise and control steps\n\n\
         `cargo xtask oracle` made this table, at eta = {ETA}, gamma = 1 and otherwise the default world, with\n\
         `cvar-game exact --env lava-point --eta {ETA} --set env.noise=SIGMA --set env.control_step=TAU --anew`.\n\n\
         - *certified*: CVaR_{} of the best controller, over 250,000 episodes in the physical world, with its 95 % interval.\n\
         - *best script*: the same of the best scripted protagonist, over 20,000 episodes.\n\
         - *own value*: the lattice's own value of the optimum, with its stated error.\n\n\
         | control step (s) | noise (m/s) | certified | best script | own value | lattice | seconds |\n\
         |---|---|---|---|---|---|---|\n",
        1.0 / f64::from(ETA)
    );
    for row in rows {
        text += &line(row);
        text.push('\n');
    }
    let agree = |which: usize| rows.iter().filter(|row| row.agrees()[which]).count();
    let _ = write!(
        text,
        "\nThe certified value is at least the best script's in {} of {} worlds. The own value is within its stated error\n\
         and three standard errors of the certified value in {}.\n",
        agree(0),
        rows.len(),
        agree(1)
    );
    text
}

fn csv(rows: &[Row]) -> String {
    let mut text = "control_step,noise,eta,certified_cvar,half_width,best_script,script_cvar,lattice_value,lattice_error,\
                    lattice,seconds\n"
        .to_owned();
    for row in rows {
        let _ = writeln!(
            text,
            "{},{},{ETA},{:.6},{:.6},{},{:.6},{:.6},{:.6},\"{}\",{:.1}",
            row.control_step,
            row.noise,
            row.certified,
            row.half_width,
            row.script.0,
            row.script.1,
            row.own,
            row.error,
            row.lattice,
            row.seconds
        );
    }
    text
}
