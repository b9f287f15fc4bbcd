//! The layers of the house, kept by reading every import: envs <- game, exact <- learn <- experiment <-
//! report <- cli, one way, and no circle between files.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use syn::visit::{self, Visit};

/// The folders and files of `src`, each with what it may import. Imports within a folder are free, but
/// for circles.
const LAYERS: [(&str, &[&str]); 8] = [
    ("files", &[]),
    ("game", &["files"]),
    ("exact", &["files", "game"]),
    ("learn", &["files", "game"]),
    ("experiment", &["files", "game", "exact", "learn"]),
    ("report", &["files", "game", "exact", "learn", "experiment"]),
    ("cli", &["files", "game", "exact", "learn", "experiment", "report"]),
    ("main", &["cli", "experiment"]),
];

/// The modules of a crate by their paths: `learn::network::fused` and its source.
type Modules = BTreeMap<Vec<String>, String>;

/// Every file below a folder of sources.
fn modules(root: &Path) -> Modules {
    let mut found = Modules::new();
    let mut folders = vec![(PathBuf::from(root), Vec::new())];
    while let Some((folder, above)) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let mut module: Vec<String> = above.clone();
            if path.is_dir() {
                module.push(name);
                folders.push((path, module));
            } else if path.extension().is_some_and(|ending| ending == "rs") && name != "lib" {
                if name != "mod" {
                    module.push(name);
                }
                found.insert(module, fs::read_to_string(path).unwrap());
            }
        }
    }
    found
}

/// Collects the modules that a file refers to, outside of its tests.
struct Imports<'a> {
    modules: &'a Modules,
    own: Vec<String>,
    found: BTreeSet<Vec<String>>,
}

impl Imports<'_> {
    /// Notes the module that a path leads to: its longest beginning that is a file.
    fn note(&mut self, path: &[String]) {
        let mut absolute = self.own.clone();
        let mut rest = path;
        match path.first().map(String::as_str) {
            Some("crate" | "cvar_game") => {
                absolute.clear();
                rest = &path[1..];
            }
            Some("self") => rest = &path[1..],
            Some("super") => {}
            _ => return,
        }
        while let Some((first, after)) = rest.split_first()
            && first == "super"
        {
            absolute.pop();
            rest = after;
        }
        absolute.extend(rest.iter().cloned());
        while !absolute.is_empty() && !self.modules.contains_key(&absolute) {
            absolute.pop();
        }
        if !absolute.is_empty() && absolute != self.own {
            self.found.insert(absolute);
        }
    }

    fn tree(&mut self, tree: &syn::UseTree, before: &[String]) {
        match tree {
            syn::UseTree::Path(path) => {
                let before = [before, &[path.ident.to_string()]].concat();
                self.tree(&path.tree, &before);
            }
            syn::UseTree::Group(group) => {
                group.items.iter().for_each(|tree| self.tree(tree, before));
            }
            syn::UseTree::Name(name) => self.note(&[before, &[name.ident.to_string()]].concat()),
            syn::UseTree::Rename(name) => self.note(&[before, &[name.ident.to_string()]].concat()),
            syn::UseTree::Glob(_) => self.note(before),
        }
    }
}

impl<'ast> Visit<'ast> for Imports<'_> {
    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        self.tree(&item.tree, &[]);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let names: Vec<String> = path.segments.iter().map(|of| of.ident.to_string()).collect();
        self.note(&names);
        visit::visit_path(self, path);
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        let is_test = item.attrs.iter().any(|of| {
            of.path().is_ident("cfg")
                && of.parse_args::<syn::Path>().is_ok_and(|path| path.is_ident("test"))
        });
        if !is_test {
            visit::visit_item_mod(self, item);
        }
    }
}

/// The imports of every module; a module and the folder below it are different files.
fn imports(modules: &Modules) -> BTreeMap<Vec<String>, BTreeSet<Vec<String>>> {
    let of = |(own, text): (&Vec<String>, &String)| {
        let mut imports = Imports { modules, own: own.clone(), found: BTreeSet::new() };
        let file = syn::parse_file(text).unwrap_or_else(|error| panic!("{own:?}: {error}"));
        imports.visit_file(&file);
        (own.clone(), imports.found)
    };
    modules.iter().map(of).collect()
}

/// What breaks the layers, in words.
fn violations(modules: &Modules) -> Vec<String> {
    let imports = imports(modules);
    let mut found = Vec::new();
    for (own, others) in &imports {
        let Some((layer, below)) = LAYERS.iter().find(|(layer, _)| *layer == own[0]) else {
            found.push(format!("{} is in no layer", own.join("::")));
            continue;
        };
        for other in others {
            if other[0] != *layer && !below.contains(&other[0].as_str()) {
                found.push(format!("{} imports {}", own.join("::"), other.join("::")));
            }
        }
    }
    found.extend(circles(&imports));
    found
}

/// Files that import each other, directly or through others. That a folder's `mod.rs` names its own
/// files, and they it, is no circle.
fn circles(imports: &BTreeMap<Vec<String>, BTreeSet<Vec<String>>>) -> Vec<String> {
    let related = |a: &[String], b: &[String]| a.starts_with(b) || b.starts_with(a);
    let next = |of: &Vec<String>| {
        let of = of.clone();
        imports[&of].iter().filter(move |other| !related(&of, other)).cloned()
    };
    let mut found = Vec::new();
    for start in imports.keys() {
        let mut reached: BTreeSet<Vec<String>> = BTreeSet::new();
        let mut todo: Vec<Vec<String>> = next(start).collect();
        while let Some(module) = todo.pop() {
            if reached.insert(module.clone()) {
                todo.extend(next(&module));
            }
        }
        if reached.contains(start) {
            found.push(format!("{} is in a circle of imports", start.join("::")));
        }
    }
    found
}

fn source() -> Modules {
    modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"))
}

#[test]
fn imports_go_downward_only() {
    let found = violations(&source());
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Whether a line planted at the top of a file is reported.
fn is_reported(module: &[&str], line: &str) -> bool {
    let mut modules = source();
    let module: Vec<String> = module.iter().map(|&part| part.to_owned()).collect();
    let text = modules.get_mut(&module).expect("the file to plant in");
    // Inner comments and attributes stay at the top.
    text.push_str(&format!("\n{line}\n"));
    !violations(&modules).is_empty()
}

#[test]
fn a_planted_violation_is_found() {
    assert!(is_reported(&["game", "budget"], "use crate::learn::ppo::Player;"));
    assert!(is_reported(&["exact", "mdp"], "fn up() { crate::report::write; }"));
    assert!(is_reported(&["learn", "gae"], "use super::super::experiment::run::{self};"));
    assert!(is_reported(&["experiment", "plan"], "use crate::cli as above;"));
    // A circle within a layer.
    assert!(is_reported(&["learn", "adam"], "use super::ppo::Player;"));
    assert!(!is_reported(&["learn", "ppo"], "use super::gae as also;"));
    assert!(!is_reported(&["game", "budget"], "#[cfg(test)] mod more { use crate::cli::main; }"));
}

/// The crate of the worlds does not know this one.
#[test]
fn the_worlds_know_nothing_of_the_game() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("envs/src");
    for (module, text) in modules(&folder) {
        assert!(!text.contains("cvar_game"), "{}", module.join("::"));
    }
}
