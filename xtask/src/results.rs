//! `results/README.md` from its template and the committed tables, and the claims of the documents checked against them.
//!
//! Templates are Jinja's (minijinja). They see `results/FOLDER/FILE.csv` by these functions; fields that are numbers are
//! numbers, and empty ones are not there.
//!
//! | | |
//! |---|---|
//! | `rows("FOLDER/FILE")` | the rows of a file, each by its header |
//! | `runs("FOLDER", world, eta)` | those of `runs.csv` at a world and eta, also with `method=` and `variant=` |
//! | `find("FOLDER/FILE", world, eta, name)` | the row of a table; without a name the first one |
//! | `cell("FOLDER/FILE", world, eta, key, name)` | a field of it |
//! | `paired(a, b, key)` | the mean difference of two lists of runs by seed, and the least one |
//! | `crossings("FOLDER", world, eta)` | by seed, the row of lava-grid in which the greedy protagonist passes the column in the middle |
//! | `commits("FOLDER")` | of the programs that made its runs |
//! | `where(key, value)`, `having(key)`, `below(key, number)` | rows of a list |
//! | `column(key)`, `names(key)` | values of a list: all, or each once |
//! | `median`, `mean`, `fixed(digits)`, `percent(digits)` | |

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use minijinja::value::{Kwargs, Value};
use minijinja::{Environment, Error, ErrorKind, UndefinedBehavior};
use serde_json::Value as Json;

/// Where the template is, and what it makes.
const TEMPLATE: &str = "results/README.template.md";
const PAGE: &str = "results/README.md";

/// The table of claims.
const CLAIMS: &str = "docs/claims.md";

/// A map of the fields that are not empty.
type Row = Value;

/// Writes `results/README.md`.
pub fn write(repository: &Path) -> Result<()> {
    fs::write(repository.join(PAGE), render(repository)?)
        .with_context(|| format!("cannot write {PAGE}"))
}

fn render(repository: &Path) -> Result<String> {
    let path = repository.join(TEMPLATE);
    let template = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let environment = environment(repository);
    let suite = table(repository, "suite/runs").map_err(|what| anyhow::anyhow!(what))?;
    let mut worlds: Vec<String> = Vec::new();
    let mut scenes: Vec<String> = Vec::new();
    for row in &suite {
        let env = text(row, "env");
        let (world, scene) = env.split_once('/').context("a world of the suite has a scene")?;
        for (list, name) in [(&mut worlds, world), (&mut scenes, scene)] {
            if !list.iter().any(|known| known == name) {
                list.push(name.to_owned());
            }
        }
    }
    let page = environment
        .render_str(
            &template,
            minijinja::context! { suite_worlds => worlds, suite_scenes => scenes },
        )
        .map_err(|error| anyhow::anyhow!("{TEMPLATE}: {error:#}"))?;
    Ok(page.trim().to_owned() + "\n")
}

/// Checks the claims: every quoted text is in its document, every expression is true, and every test that is named exists.
///
/// # Errors
/// All that is wrong, a line each.
pub fn check_claims(repository: &Path) -> Result<()> {
    let read = |file: &str| {
        fs::read_to_string(repository.join(file)).with_context(|| format!("cannot read {file}"))
    };
    let environment = environment(repository);
    let mut wrong = Vec::new();
    let mut document = String::new();
    let mut claims = 0;
    for line in read(CLAIMS)?.lines() {
        if let Some(heading) = line.strip_prefix("## ") {
            document = heading.trim().to_owned();
        }
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
        let [claim, rests_on, checked] = cells[..] else { continue };
        if claim == "claim" || claim.starts_with("---") {
            continue;
        }
        claims += 1;
        let flat = |text: &str| text.split_whitespace().collect::<Vec<&str>>().join(" ");
        if !flat(&read(&document)?).contains(&flat(claim)) {
            wrong.push(format!("{document} does not say: {claim}"));
        }
        for code in rests_on.split('`').skip(1).step_by(2) {
            // A pipe in a table is written with a backslash.
            let code = code.replace("\\|", "|");
            let result = environment.compile_expression(&code).and_then(|of| of.eval(()));
            match result {
                Ok(value) if value.is_true() => {}
                Ok(value) => wrong.push(format!("{claim}: {code} is {value}")),
                Err(error) => wrong.push(format!("{claim}: {code}: {error:#}")),
            }
        }
        // A file, and tests in it.
        let mut source = String::new();
        for code in checked.split('`').skip(1).step_by(2) {
            if code.contains('/') {
                source = read(code)?;
                continue;
            }
            let heads = [format!("fn {code}("), format!("def {code}(")];
            if !heads.iter().any(|head| source.contains(head)) {
                wrong.push(format!("{claim}: there is no test {code}"));
            }
        }
    }
    ensure!(claims > 0, "{CLAIMS} has no claims");
    if !wrong.is_empty() {
        bail!("{}", wrong.join("\n"));
    }
    Ok(())
}

fn environment(repository: &Path) -> Environment<'static> {
    let root = repository.to_owned();
    let mut environment = Environment::new();
    environment.set_undefined_behavior(UndefinedBehavior::Strict);
    environment.set_auto_escape_callback(|_| minijinja::AutoEscape::None);
    let at = root.clone();
    environment.add_function("rows", move |name: &str| -> Result<Value, Error> {
        Ok(Value::from(table(&at, name)?))
    });
    let at = root.clone();
    environment.add_function(
        "runs",
        move |folder: &str, world: &str, eta: f64, options: Kwargs| -> Result<Value, Error> {
            let method: Option<String> = options.get("method")?;
            let variant: Option<String> = options.get("variant")?;
            let is = |row: &Row, key: &str, wanted: &Option<String>| {
                wanted.as_ref().is_none_or(|wanted| text(row, key) == *wanted)
            };
            let mut found = table(&at, &format!("{folder}/runs"))?;
            found.retain(|row| {
                text(row, "env") == world
                    && number(row, "eta") == Some(eta)
                    && is(row, "method", &method)
                    && is(row, "variant", &variant)
            });
            Ok(Value::from(found))
        },
    );
    let at = root.clone();
    environment.add_function(
        "find",
        move |name: &str, world: &str, eta: f64, of: Option<&str>| -> Result<Value, Error> {
            Ok(find(&at, name, world, eta, of)?.unwrap_or_else(|| Value::from(false)))
        },
    );
    let at = root.clone();
    environment.add_function(
        "cell",
        move |name: &str,
              world: &str,
              eta: f64,
              key: &str,
              of: Option<&str>|
              -> Result<Value, Error> {
            let missing = || failure(format!("{name}, {world}, eta = {eta}: there is no {key}"));
            find(&at, name, world, eta, of)?.and_then(|row| field(&row, key)).ok_or_else(missing)
        },
    );
    environment.add_function("paired", |a: Vec<Row>, b: Vec<Row>, key: &str| paired(&a, &b, key));
    let at = root.clone();
    environment.add_function("crossings", move |folder: &str, world: &str, eta: f64| {
        crossings(&at, folder, world, eta).map_err(|error| failure(format!("{error:#}")))
    });
    let at = root.clone();
    environment.add_function("commits", move |folder: &str| {
        commits(&at, folder).map_err(|error| failure(format!("{error:#}")))
    });
    environment.add_filter("difficulty", move |scene: &str| {
        difficulty(&root, scene).map_err(|error| failure(format!("{error:#}")))
    });
    environment.add_filter("where", |rows: Vec<Row>, key: &str, value: Value| -> Vec<Row> {
        rows.into_iter().filter(|row| field(row, key).as_ref() == Some(&value)).collect()
    });
    environment.add_filter("having", |rows: Vec<Row>, key: &str| -> Vec<Row> {
        rows.into_iter().filter(|row| field(row, key).is_some()).collect()
    });
    environment.add_filter("below", |rows: Vec<Row>, key: &str, limit: f64| -> Vec<Row> {
        rows.into_iter().filter(|row| number(row, key).is_some_and(|of| of < limit)).collect()
    });
    environment.add_filter("column", |rows: Vec<Row>, key: &str| -> Vec<f64> {
        rows.iter().filter_map(|row| number(row, key)).collect()
    });
    environment.add_filter("names", |rows: Vec<Row>, key: &str| -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for row in rows.iter().filter(|row| number(row, "seeds").is_none_or(|seeds| seeds > 0.0)) {
            let name = text(row, key);
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    });
    environment.add_filter("median", |mut values: Vec<f64>| -> Result<f64, Error> {
        values.sort_by(f64::total_cmp);
        let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
        let middle = values.get(low).zip(values.get(high));
        middle.map(|(low, high)| 0.5 * (low + high)).ok_or_else(|| failure("a median of nothing"))
    });
    environment.add_filter("mean", |values: Vec<f64>| -> Result<f64, Error> {
        if values.is_empty() {
            return Err(failure("a mean of nothing"));
        }
        Ok(values.iter().sum::<f64>() / values.len() as f64)
    });
    environment.add_filter("fixed", |value: f64, digits: usize| fixed(value, digits));
    environment.add_filter("percent", |value: f64, digits: usize| fixed(100.0 * value, digits));
    environment
}

fn failure(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::InvalidOperation, what.into())
}

/// What makes a scene hard, by its file.
fn difficulty(repository: &Path, scene: &str) -> Result<String> {
    let path = repository.join(format!("configs/scenes/{scene}.toml"));
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let scene: toml::Table = text.parse().with_context(|| path.display().to_string())?;
    let difficulty = scene.get("difficulty").and_then(toml::Value::as_str);
    Ok(difficulty.context("a scene of the suite has a difficulty")?.to_owned())
}

/// A number with so many decimals, without a minus before a zero.
fn fixed(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.chars().all(|of| matches!(of, '0' | '.')) => rest.to_owned(),
        _ => text,
    }
}

fn field(row: &Row, key: &str) -> Option<Value> {
    row.get_attr(key).ok().filter(|value| !value.is_undefined())
}

fn text(row: &Row, key: &str) -> String {
    field(row, key).map_or_else(String::new, |value| value.to_string())
}

fn number(row: &Row, key: &str) -> Option<f64> {
    field(row, key).and_then(|value| f64::try_from(value).ok())
}

/// The rows of `results/NAME.csv`.
fn table(repository: &Path, name: &str) -> Result<Vec<Row>, Error> {
    let path = repository.join("results").join(format!("{name}.csv"));
    let wrong = |error: csv::Error| failure(format!("{}: {error}", path.display()));
    let mut reader = csv::Reader::from_path(&path).map_err(wrong)?;
    let header = reader.headers().map_err(wrong)?.clone();
    let row = |record: Result<csv::StringRecord, csv::Error>| {
        let record = record.map_err(wrong)?;
        let filled = header.iter().zip(&record).filter(|(_, field)| !field.is_empty());
        let value = |field: &str| match (field.parse::<i64>(), field.parse::<f64>()) {
            (Ok(whole), _) => Value::from(whole),
            (_, Ok(value)) => Value::from(value),
            _ => Value::from(field),
        };
        let row: BTreeMap<String, Value> =
            filled.map(|(key, field)| (key.to_owned(), value(field))).collect();
        Ok(Value::from(row))
    };
    reader.records().map(row).collect()
}

fn find(
    repository: &Path,
    name: &str,
    world: &str,
    eta: f64,
    of: Option<&str>,
) -> Result<Option<Row>, Error> {
    let named = |row: &Row| {
        let names = ["folder", "method"].map(|key| text(row, key));
        of.is_none_or(|of| names.iter().any(|name| name == of))
    };
    let is = |row: &Row| text(row, "env") == world && number(row, "eta") == Some(eta) && named(row);
    Ok(table(repository, name)?.into_iter().find(is))
}

/// `MEAN, at least LEAST`, of the differences by seed.
fn paired(a: &[Row], b: &[Row], key: &str) -> Result<String, Error> {
    let differences: Vec<f64> = a
        .iter()
        .filter_map(|row| {
            let twin = b.iter().find(|twin| number(twin, "seed") == number(row, "seed"))?;
            Some(number(row, key)? - number(twin, key)?)
        })
        .collect();
    if differences.is_empty() {
        return Err(failure(format!("no pairs with a {key}")));
    }
    let mean = differences.iter().sum::<f64>() / differences.len() as f64;
    let least = differences.iter().copied().fold(f64::INFINITY, f64::min);
    Ok(format!(
        "{} on average, {} on the worst of {} seeds",
        fixed(mean, 3),
        fixed(least, 3),
        differences.len()
    ))
}

/// The members of a folder's archive of this file name, with their paths.
fn members(repository: &Path, folder: &str, file: &str) -> Result<Vec<(PathBuf, Json)>> {
    let path = repository.join("results").join(folder).join("runs.zip");
    let archive = File::open(&path).with_context(|| path.display().to_string())?;
    let mut archive = zip::ZipArchive::new(archive)?;
    let names: Vec<String> =
        archive.file_names().filter(|name| name.ends_with(file)).map(str::to_owned).collect();
    let mut found = Vec::new();
    for name in names {
        let mut text = String::new();
        archive.by_name(&name)?.read_to_string(&mut text)?;
        found.push((PathBuf::from(&name), serde_json::from_str(&text)?));
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(found)
}

/// A dash stands for a protagonist that does not get there.
fn crossings(repository: &Path, folder: &str, world: &str, eta: f64) -> Result<Vec<String>> {
    let place = format!("{world}/game/eta-{eta}/");
    let mut rows = Vec::new();
    for (path, data) in members(repository, folder, "figure_data.json")? {
        if !path.starts_with(&place) {
            continue;
        }
        let occupancy = data["world"]["cells"]["occupancy"].as_array();
        let occupancy =
            occupancy.with_context(|| format!("{} has no occupancy", path.display()))?;
        // The paper's map: ten columns, seven rows.
        ensure!(occupancy.len() == 70, "{} is of another map", path.display());
        let share = |row: &usize| occupancy[10 * row + 5].as_f64().unwrap_or_default();
        let passed = (0..7).max_by(|a, b| share(a).total_cmp(&share(b)));
        let passed = passed.filter(|row| share(row) >= 0.5);
        rows.push(passed.map_or("–".to_owned(), |row| row.to_string()));
    }
    Ok(rows)
}

fn commits(repository: &Path, folder: &str) -> Result<Vec<String>> {
    let manifests = members(repository, folder, "manifest.json")?;
    let mut commits: BTreeMap<String, usize> = BTreeMap::new();
    for (_, manifest) in &manifests {
        let commit = manifest["commit"].as_str().unwrap_or("unknown");
        *commits.entry(commit.chars().take(7).collect()).or_default() += 1;
    }
    let said = |(commit, count): (String, usize)| format!("{commit} ({count})");
    Ok(commits.into_iter().map(said).collect())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    fn repository() -> &'static Path {
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository")
    }

    #[test]
    fn the_page_of_results_is_up_to_date() {
        let found = super::render(repository()).expect("the page");
        let written = std::fs::read_to_string(repository().join(super::PAGE)).expect("the page");
        assert!(found == written, "run `cargo xtask results`");
    }

    #[test]
    fn the_claims_of_the_documents_hold() {
        super::check_claims(repository()).unwrap_or_else(|error| panic!("{error:#}"));
    }
}
