//! What the documents and the help texts mention exists: paths in the tree, verbs and options of the
//! program, verbs of `cargo xtask`, keys of the configuration, and relative links.
//!
//! In Markdown, code is checked (spans and blocks), and links are. In a help text every word is.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use toml::{Table, Value};

/// Folders that a sentence or an example names as output, without a configuration of their name.
const OUTPUTS: [&str; 2] = ["results/train", "results/slippery"];

/// A placeholder for a name that the reader chooses, as in `src/learn/methods/NAME.rs`.
const PLACEHOLDER: &str = "NAME";

/// Sections of the configuration, at which a key begins.
const SECTIONS: [&str; 5] = ["train.", "env.", "experiment.", "evaluation.", "checkpoint."];

/// What can be mentioned.
struct Facts {
    root: PathBuf,
    /// Names of all files in the tree.
    names: BTreeSet<String>,
    /// Verbs of the program with their options; the program's own options have the verb "".
    verbs: BTreeMap<String, BTreeSet<String>>,
    /// Verbs of `cargo xtask`.
    chores: BTreeSet<String>,
    /// All keys of the configuration.
    options: Table,
}

impl Facts {
    fn collect() -> Facts {
        let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
        let help = help(&[]);
        let mut verbs = BTreeMap::from([(String::new(), options(&help))]);
        for verb in listed_verbs(&help) {
            let options = options(&self::help(&[&verb]));
            verbs.insert(verb, options);
        }
        Facts {
            names: names(&root),
            verbs,
            chores: chores(&root.join("xtask/src/main.rs")),
            options: toml::from_str(&answer(&["config", "--default"])).unwrap(),
            root,
        }
    }
}

/// What the program answers; its standard output.
fn answer(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_cvar-game")).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn help(verb: &[&str]) -> String {
    answer(&[verb, &["--help"]].concat())
}

/// The verbs in the list of commands of a help text.
fn listed_verbs(help: &str) -> Vec<String> {
    let list = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let entries = list.take_while(|line| !line.is_empty());
    let verb = |line: &str| line.split_whitespace().next().map(str::to_owned);
    entries.filter_map(verb).filter(|verb| verb != "help").collect()
}

/// The options that a help text explains: `--config <FILE>` at the beginning of a line.
fn options(help: &str) -> BTreeSet<String> {
    let lines = help.lines().filter(|line| line.trim_start().starts_with('-'));
    let long = |line: &str| {
        let start = line.find("--")?;
        let end = |text: &str| text.find([' ', '=', ',']).unwrap_or(text.len());
        Some(line[start..start + end(&line[start..])].to_owned())
    };
    lines.filter_map(long).collect()
}

/// The variants of `enum Verb` of xtask, as clap names them.
fn chores(source: &Path) -> BTreeSet<String> {
    let file = syn::parse_file(&fs::read_to_string(source).unwrap()).unwrap();
    let verbs = file.items.iter().find_map(|item| match item {
        syn::Item::Enum(found) if found.ident == "Verb" => Some(found),
        _ => None,
    });
    let variants = verbs.expect("enum Verb").variants.iter();
    variants.map(|variant| variant.ident.to_string().to_lowercase()).collect()
}

/// The names of all files of the tree, build outputs and results apart.
fn names(root: &Path) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let entry = entry.unwrap();
            let name = entry.file_name().to_string_lossy().into_owned();
            if !entry.file_type().unwrap().is_dir() {
                found.insert(name);
            } else if !["target", ".git", ".libtorch", "results"].contains(&name.as_str()) {
                folders.push(entry.path());
            }
        }
    }
    found
}

/// A document, taken apart.
#[derive(Default)]
struct Markdown {
    /// Command lines of code blocks, continued lines joined.
    lines: Vec<String>,
    /// Code within sentences.
    spans: Vec<String>,
    /// Targets of links.
    links: Vec<String>,
    /// Anchors of headings.
    anchors: BTreeSet<String>,
    /// Whether every span that begins also ends.
    balanced: bool,
}

impl Markdown {
    fn read(text: &str) -> Markdown {
        let mut found = Markdown::default();
        let (mut block, mut prose) = (String::new(), String::new());
        let (mut fenced, mut blank, mut indented) = (false, true, false);
        // The tests of the Python package run its blocks.
        let mut python = false;
        for line in text.lines() {
            if let Some(language) = line.trim_start().strip_prefix("```") {
                fenced = !fenced;
                python = language == "python";
                continue;
            }
            if fenced && python {
                continue;
            }
            indented = line.starts_with("    ") && (blank || indented);
            blank = line.trim().is_empty();
            let part = if fenced || indented { &mut block } else { &mut prose };
            part.push_str(line);
            part.push('\n');
        }
        found.lines = block.replace("\\\n", " ").lines().map(str::to_owned).collect();
        found.balanced = prose.matches('`').count() % 2 == 0;
        let spans = prose.split('`').skip(1).step_by(2);
        found.spans = spans.map(|span| span.replace('\n', " ")).collect();
        let targets = prose.split("](").skip(1).filter_map(|rest| rest.split_once(')'));
        found.links = targets.map(|(target, _)| target.to_owned()).collect();
        let headings = prose.lines().filter(|line| line.starts_with('#'));
        found.anchors = headings.map(anchor).collect();
        found
    }
}

/// The anchor that GitHub gives a heading.
fn anchor(heading: &str) -> String {
    let text = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = text.chars().filter(|of| of.is_alphanumeric() || " -_".contains(*of));
    kept.map(|of| if of == ' ' { '-' } else { of }).collect()
}

/// The words of a command or a sentence, without quotes and punctuation around them.
fn words(text: &str) -> Vec<String> {
    let word = |word: &str| {
        let word = word.trim_matches(|of| "\"'`,;:()[]{}$".contains(of));
        word.strip_suffix('.').unwrap_or(word).to_owned()
    };
    text.split_whitespace().map(word).collect()
}

/// A word that the reader is to replace, such as FILE or RUN_ID.
fn is_placeholder(word: &str) -> bool {
    word.chars().any(|of| of.is_ascii_uppercase()) || word.starts_with('<')
}

impl Facts {
    /// Every wrong mention in a Markdown document, which lies at `path` below the root.
    fn wrong_in_markdown(&self, path: &str, text: &str) -> Vec<String> {
        let markdown = Markdown::read(text);
        let mut found = Vec::new();
        if !markdown.balanced {
            found.push("a backtick without another one".to_owned());
        }
        for line in &markdown.lines {
            self.check_line(line, &mut found);
        }
        for span in &markdown.spans {
            self.check_line(span, &mut found);
            self.check_span(&words(span), &mut found);
        }
        for link in &markdown.links {
            self.check_link(path, link, &markdown.anchors, &mut found);
        }
        found
    }

    /// Every wrong mention in a help text.
    fn wrong_in_help(&self, text: &str) -> Vec<String> {
        let mut found = Vec::new();
        text.lines().for_each(|line| self.check_line(line, &mut found));
        found
    }

    /// Paths, keys and commands in a line of code.
    fn check_line(&self, line: &str, found: &mut Vec<String>) {
        let words = words(line);
        for word in &words {
            let word = word.split('=').next().unwrap_or(word);
            if !self.has_path(word) {
                found.push(format!("{word}: there is no such path"));
            }
            if !self.has_key(word) {
                found.push(format!("{word}: there is no such option of the configuration"));
            }
        }
        for (at, word) in words.iter().enumerate() {
            let rest = &words[at + 1..];
            if word == "cvar-game" || word.ends_with("target/release/cvar-game") {
                self.check_command(rest, found);
            } else if word == "cargo" {
                self.check_cargo(rest, found);
            }
        }
    }

    /// The words after the name of the program.
    fn check_command(&self, words: &[String], found: &mut Vec<String>) {
        let Some(verb) = words.first().filter(|word| !word.is_empty()) else { return };
        if verb.starts_with("--") {
            return self.check_options("", words, found);
        }
        if is_placeholder(verb) || !verb.chars().all(|of| of.is_ascii_lowercase()) {
            return;
        }
        match self.verbs.contains_key(verb) {
            true => self.check_options(verb, &words[1..], found),
            false => found.push(format!("cvar-game {verb}: there is no such verb")),
        }
    }

    /// The options of a command, as far as it goes.
    fn check_options(&self, verb: &str, words: &[String], found: &mut Vec<String>) {
        let ends = ["|", "&&", ">", "::::", "--", "#"];
        for word in words.iter().take_while(|word| !ends.contains(&word.as_str())) {
            let option = word.split('=').next().unwrap_or(word);
            if option.starts_with("--") && !self.verbs[verb].contains(option) {
                found.push(format!("cvar-game {verb} {option}: there is no such option"));
            }
        }
    }

    /// The words after `cargo`.
    fn check_cargo(&self, words: &[String], found: &mut Vec<String>) {
        match words.first().map(String::as_str) {
            Some("xtask") => {
                let verb = words.get(1).filter(|word| !word.is_empty() && !is_placeholder(word));
                if verb.is_some_and(|verb| !self.chores.contains(verb)) {
                    found.push(format!("cargo xtask {}: there is no such verb", words[1]));
                }
            }
            Some("run") => {
                if let Some(at) = words.iter().position(|word| word == "--") {
                    self.check_command(&words[at + 1..], found);
                }
            }
            _ => {}
        }
        let targets = [("--test", "tests"), ("--example", "examples"), ("--bench", "benches")];
        for (option, folder) in targets {
            let named = words.windows(2).filter(|pair| pair[0] == option);
            for path in named.map(|pair| format!("{folder}/{}.rs", pair[1])) {
                if !self.root.join(&path).exists() {
                    found.push(format!("{path}: there is no such path"));
                }
            }
        }
    }

    /// A span that begins with a verb or an option, as in "`bench --only RUN_ID`" or "`--jobs`".
    fn check_span(&self, words: &[String], found: &mut Vec<String>) {
        let first = &words.first().map_or("", String::as_str);
        let option = first.split('=').next().unwrap_or(first);
        if self.verbs.contains_key(*first) && words.len() > 1 {
            self.check_options(first, &words[1..], found);
        } else if option.len() > 2
            && option.starts_with("--")
            && !self.verbs.values().any(|options| options.contains(option))
        {
            found.push(format!("{option}: no verb has such an option"));
        }
    }

    /// Whether a word is no path of the repository, or one that exists.
    fn has_path(&self, word: &str) -> bool {
        let Some((folder, rest)) = word.split_once('/') else {
            let is_source = word.ends_with(".rs");
            let is_document = word.ends_with(".md") && word.starts_with(|c: char| c.is_uppercase());
            return !(is_source || is_document) || word.len() == 3 || self.names.contains(word);
        };
        let folders =
            ["src", "envs", "tests", "configs", "results", "docs", "xtask", "benches", "examples"];
        if !(folders.contains(&folder) || [".ci", ".cargo"].contains(&folder)) {
            return true;
        }
        let path = Path::new(word);
        if self.root.join(path).exists() || OUTPUTS.contains(&word) {
            return true;
        }
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        if stem == PLACEHOLDER || stem == "*" {
            return self.root.join(path.parent().unwrap()).is_dir();
        }
        folder == "results" && self.is_output(rest)
    }

    /// Whether a path below `results` is what a sweep of a configuration writes: its folder, or that of a
    /// run WORLD/METHOD[/VARIANT]/eta-E/seed-N.
    fn is_output(&self, path: &str) -> bool {
        let mut parts = path.trim_end_matches('/').split('/');
        let sweep = parts.next().unwrap_or_default();
        if !self.root.join(format!("configs/{sweep}.toml")).exists() {
            return false;
        }
        match parts.collect::<Vec<_>>()[..] {
            [] => true,
            [world, .., eta, seed] => {
                let worlds = self.options["env"].as_table().unwrap();
                worlds.contains_key(world) && eta.starts_with("eta-") && seed.starts_with("seed-")
            }
            _ => false,
        }
    }

    /// Whether a word is no key of the configuration, or one that exists.
    fn has_key(&self, word: &str) -> bool {
        let is_key = SECTIONS.iter().any(|section| word.starts_with(section))
            && word
                .chars()
                .all(|of| of.is_ascii_lowercase() || of.is_ascii_digit() || "._-".contains(of))
            && ![".json", ".md", ".rs", ".toml"].iter().any(|ending| word.ends_with(ending));
        if !is_key {
            return true;
        }
        let keys: Vec<&str> = word.split('.').collect();
        let options = &self.options;
        let worlds = options["env"].as_table().unwrap();
        match keys[..] {
            // A world's own training options are those of all worlds.
            ["env", world, "train", ..] if worlds.contains_key(world) => leads(options, &keys[2..]),
            ["env", world, ..] if worlds.contains_key(world) => leads(options, &keys),
            ["env", ..] => {
                let has = |world: &Value| leads(world.as_table().unwrap(), &keys[1..]);
                worlds.values().any(has)
            }
            _ => leads(options, &keys),
        }
    }

    /// A link of the document at `path`, whose own anchors are `anchors`.
    fn check_link(
        &self,
        path: &str,
        link: &str,
        anchors: &BTreeSet<String>,
        found: &mut Vec<String>,
    ) {
        if link.contains("://") {
            return;
        }
        let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
        let target = self.root.join(path).parent().unwrap().join(file);
        if !file.is_empty() && !target.exists() {
            found.push(format!("link to {link}: there is no such file"));
        } else if !anchor.is_empty() {
            let has = if file.is_empty() {
                anchors.contains(anchor)
            } else {
                Markdown::read(&fs::read_to_string(target).unwrap()).anchors.contains(anchor)
            };
            if !has {
                found.push(format!("link to {link}: there is no such heading"));
            }
        }
    }
}

/// Whether keys lead to a value or a section of a table.
fn leads(table: &Table, keys: &[&str]) -> bool {
    match keys {
        [] => true,
        [key] => table.contains_key(*key),
        [key, rest @ ..] => {
            table.get(*key).and_then(Value::as_table).is_some_and(|of| leads(of, rest))
        }
    }
}

/// The documents: at the root and in `docs`.
fn documents(root: &Path) -> Vec<String> {
    let mut found = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"].map(str::to_owned).to_vec();
    for entry in fs::read_dir(root.join("docs")).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        if name.ends_with(".md") {
            found.push(format!("docs/{name}"));
        }
    }
    found.sort();
    found
}

#[test]
fn what_documents_mention_exists() {
    let facts = Facts::collect();
    let mut found = Vec::new();
    for path in documents(&facts.root) {
        let text = fs::read_to_string(facts.root.join(&path)).unwrap();
        let wrong = facts.wrong_in_markdown(&path, &text);
        found.extend(wrong.iter().map(|what| format!("{path}: {what}")));
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn what_help_texts_mention_exists() {
    let facts = Facts::collect();
    let mut found = Vec::new();
    for verb in facts.verbs.keys() {
        let verb_of = if verb.is_empty() { vec![] } else { vec![verb.as_str()] };
        let wrong = facts.wrong_in_help(&help(&verb_of));
        found.extend(wrong.iter().map(|what| format!("cvar-game {verb} --help: {what}")));
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_planted_wrong_mention_is_found() {
    let facts = Facts::collect();
    let wrong = |text: &str| facts.wrong_in_markdown("docs/planted.md", text).len();
    for text in [
        "See `src/learn/contest.rs`.",
        "See `no_such_file.rs`.",
        "See `docs/*.md` and `src/nowhere/*.rs`.",
        "Copy it to `src/nowhere/NAME.rs`.",
        "The results are in `results/papers`.",
        "The run `results/quick/lava-lake/game/eta-25/seed-1`.",
        "Run `cvar-game exhibits DIR`.",
        "Run `cvar-game bench\n--joobs 2`.",
        "Run `target/release/cvar-game table DIR --comparre=OTHER`.",
        "Use `--comparre DIR`.",
        "Use `bench --steps 5`.",
        "Text\n\n    cargo run --release -- benhc\n",
        "Text\n\n    cvar-game bench --jobs 2 \\\n        --onnly RUN_ID\n",
        "```\ncargo xtask bench\n```",
        "Run `cargo test --test nothing`.",
        "Run `cargo run --example nothing`.",
        "Set `train.protagonist.minibach`.",
        "Set `--set env.slipp=0.1`.",
        "Set `env.lava-grid.train.credits`.",
        "See [this](nothing.md).",
        "See [this](../README.md#nothing).",
        "# Head\n\nSee [this](#tail).",
        "A `span that does not end.",
    ] {
        assert_eq!(wrong(text), 1, "{text}");
    }
    for text in [
        "See `src/learn/method.rs`, `uniform.rs` and `docs/*.md`.",
        "Copy it to `src/learn/methods/NAME.rs`.",
        "The run `results/quick/lava-grid/game/eta-25/seed-1`.",
        "Run `cvar-game VERB --help`, `cvar-game --help` or `cargo xtask VERB`.",
        "Text\n\n    cargo run --release -- bench --jobs 2\n    cargo xtask torch build --release\n",
        "Run `cargo test --test documents -- --ignored`.",
        "Use `--jobs`, or `bench --only RUN_ID`.",
        "Set `train.protagonist.minibatch`, `env.slip`, `env.lava-grid.train.credit` or `env.KEY`.",
        "# A head\n\nSee [this](#a-head) or [that](../README.md).",
    ] {
        assert_eq!(wrong(text), 0, "{text}");
    }
    assert_eq!(facts.wrong_in_help("Examples:\n  cvar-game slrum --config FILE").len(), 1);
}

/// The excerpt in the README shows numbers of the table that it names.
#[test]
fn the_readme_shows_numbers_of_the_committed_table() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let table = fs::read_to_string(root.join("results/paper/table.md")).unwrap();
    let readme = fs::read_to_string(root.join("README.md")).unwrap();
    let cells = |line: &str| -> Vec<String> {
        line.split('|').map(|cell| cell.trim().replace("**", "")).collect()
    };
    let mut rows = 0;
    for row in readme.lines().filter(|line| line.starts_with("| lava-")) {
        let [_, world, eta, numbers @ .., _] = &cells(row)[..] else { panic!("{row}") };
        let section = table.split(&format!("## {world}\n")).nth(1).unwrap();
        let section = section.split("\n## ").next().unwrap();
        let of_eta = section.lines().map(cells).filter(|cells| cells.get(1) == Some(eta));
        let values: BTreeSet<String> =
            of_eta.flatten().map(|cell| cell.split(' ').next().unwrap().to_owned()).collect();
        assert!(numbers.len() > 3, "{row}");
        for number in numbers {
            assert!(values.contains(number), "{world}, eta {eta}: {number} is not in the table");
        }
        rows += 1;
    }
    assert!(rows >= 2, "the README has no excerpt");
}
