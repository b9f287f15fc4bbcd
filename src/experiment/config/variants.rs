//! Variants of an experiment: named sets of options, and axes, whose every combination is a variant.

use super::annotated::Schema;
use super::keys::dotted_leaves;
use super::layers::{Layer, Setting};
use super::{ConfigError, Experiment, one_line, rules};
use crate::experiment::names::{MethodName, VariantName, WorldName};
use crate::game::budget::Eta;
use serde::Deserialize;
use toml::{Table, Value};

/// The most variants of an experiment: a typing error should be refused rather than plan years of runs.
const MOST_VARIANTS: usize = 1_000;

/// A variant before its options are resolved.
#[derive(Debug, Clone)]
pub(super) struct Draft {
    pub name: VariantName,
    pub envs: Vec<WorldName>,
    pub methods: Vec<MethodName>,
    pub etas: Vec<Eta>,
    /// What it sets; it overrides the files, and the command line overrides it.
    pub set: Vec<Setting>,
}

/// `[[experiment.variant]]`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Named {
    name: VariantName,
    envs: Option<Vec<WorldName>>,
    methods: Option<Vec<MethodName>>,
    etas: Option<Vec<Eta>>,
    #[serde(default)]
    set: Table,
}

/// An entry of `[experiment.axes]`.
#[derive(Debug)]
struct Axis {
    key: String,
    origin: String,
    values: Vec<Value>,
}

/// The name of a variant and what it sets, or a part of both.
#[derive(Debug, Clone, Default)]
struct Part {
    name: String,
    /// Keys, where they are set, and values.
    set: Vec<(String, String, Value)>,
}

/// The variants of the layers; empty if they have neither variants nor axes. A variant's own worlds,
/// methods and etas replace the experiment's, except where `settings` of the command line choose:
/// then it keeps those of its own that are chosen.
pub(super) fn drafts(
    stack: &[Layer],
    experiment: &Experiment,
    settings: &[Setting],
    schema: &Schema,
) -> Result<Vec<Draft>, ConfigError> {
    let named = named(stack, schema)?;
    let axes = axes(stack)?;
    if named.is_empty() && axes.is_empty() {
        return Ok(Vec::new());
    }
    let sizes = axes.iter().map(|axis| axis.values.len()).chain([named.len().max(1)]);
    let count = sizes.fold(1_usize, usize::saturating_mul);
    if count > MOST_VARIANTS {
        return Err(ConfigError::Conflict(format!(
            "the experiment has {count} variants, its axes times its named variants; use at most \
             {MOST_VARIANTS}"
        )));
    }
    let chosen = |list: &str| {
        let list = format!("experiment.{list}");
        settings.iter().any(|setting| setting.key() == list)
    };
    let combinations = combinations(&axes);
    let mut drafts: Vec<Draft> = Vec::new();
    let unnamed = Named::nothing();
    for (own, part) in if named.is_empty() { vec![(unnamed, Part::default())] } else { named } {
        for combination in &combinations {
            let part = part.with(combination)?;
            let name: VariantName = part.name.parse().map_err(|error| {
                ConfigError::Conflict(format!("{error} (a variant of the experiment)"))
            })?;
            let draft = Draft {
                envs: kept(own.envs.as_deref(), &experiment.envs, chosen("envs")),
                methods: kept(own.methods.as_deref(), &experiment.methods, chosen("methods")),
                etas: kept(own.etas.as_deref(), &experiment.etas, chosen("etas")),
                set: part.settings(&name, schema)?,
                name,
            };
            // One name may be of other settings in another world, method or eta.
            if drafts.iter().any(|of| draft.overlaps(of)) {
                return Err(ConfigError::Conflict(format!(
                    "there are two variants named {} for the same runs; give each its own name, or other \
                     envs, methods or etas",
                    draft.name
                )));
            }
            if !(draft.envs.is_empty() || draft.methods.is_empty() || draft.etas.is_empty()) {
                drafts.push(draft);
            }
        }
    }
    if drafts.is_empty() {
        return Err(ConfigError::Conflict(
            "no variant of the experiment has the worlds, methods and etas that the command line \
             chooses; choose others"
                .to_owned(),
        ));
    }
    Ok(drafts)
}

impl Draft {
    /// Whether both have the same name and a run in common.
    fn overlaps(&self, other: &Draft) -> bool {
        fn meet<T: PartialEq>(ours: &[T], theirs: &[T]) -> bool {
            ours.iter().any(|of| theirs.contains(of))
        }
        self.name == other.name
            && meet(&self.envs, &other.envs)
            && meet(&self.methods, &other.methods)
            && meet(&self.etas, &other.etas)
    }
}

fn kept<T: Clone + PartialEq>(own: Option<&[T]>, experiment: &[T], chosen: bool) -> Vec<T> {
    match own {
        None => experiment.to_vec(),
        Some(own) if !chosen => own.to_vec(),
        Some(own) => own.iter().filter(|of| experiment.contains(of)).cloned().collect(),
    }
}

impl Named {
    /// What the combinations of axes vary where there is no named variant.
    fn nothing() -> Named {
        Named {
            name: "base".parse().expect("a name"),
            envs: None,
            methods: None,
            etas: None,
            set: Table::new(),
        }
    }
}

impl Part {
    /// Both parts together.
    fn with(&self, other: &Part) -> Result<Part, ConfigError> {
        for (key, ..) in &other.set {
            if self.set.iter().any(|(own, ..)| own == key) {
                return Err(ConfigError::Conflict(format!(
                    "the variant {} sets {key}, which is also an axis of the experiment; leave one of \
                     them out",
                    self.name
                )));
            }
        }
        let name = [self.name.as_str(), other.name.as_str()].map(str::to_owned);
        let name: Vec<String> = name.into_iter().filter(|name| !name.is_empty()).collect();
        let set = self.set.iter().chain(&other.set).cloned().collect();
        Ok(Part { name: name.join("+"), set })
    }

    fn settings(&self, name: &VariantName, schema: &Schema) -> Result<Vec<Setting>, ConfigError> {
        let setting = |(key, origin, value): &(String, String, Value)| {
            let origin = format!("{origin}, variant {name}");
            let refused = |advice: String| ConfigError::UnknownKey {
                key: key.clone(),
                origin: origin.clone(),
                advice,
            };
            if key.split('.').next().is_some_and(|first| first.trim() == "experiment") {
                return Err(refused(
                    "a variant sets options of its runs; give its worlds, methods and etas as envs, \
                     methods and etas of the variant"
                        .to_owned(),
                ));
            }
            Setting::of_variant(&origin, key, value.clone())
                .ok_or_else(|| refused(schema.advice(key)))
        };
        self.set.iter().map(setting).collect()
    }
}

/// The named variants, of the last layer that has any.
fn named(stack: &[Layer], schema: &Schema) -> Result<Vec<(Named, Part)>, ConfigError> {
    const KEY: &str = "experiment.variant";
    let last = stack.iter().rev().find_map(|layer| Some((layer, layer.variants.as_ref()?)));
    let Some((Layer { origin, .. }, value)) = last else { return Ok(Vec::new()) };
    let sections = || rules::refused(KEY, value, origin, "a list of [[experiment.variant]]".into());
    let Value::Array(variants) = value else { return Err(sections()) };
    let mut found = Vec::new();
    for (index, variant) in variants.iter().enumerate() {
        let Value::Table(table) = variant else { return Err(sections()) };
        let label = match table.get("name") {
            Some(Value::String(name)) => format!("{origin}, variant {}", one_line(name)),
            _ => format!("{origin}, variant {}", index + 1),
        };
        for list in ["envs", "methods", "etas"] {
            if let Some(value) = table.get(list) {
                let (key, ruling) = (format!("{KEY}.{list}"), format!("experiment.{list}"));
                schema.check_as(&ruling, &key, value, &label)?;
            }
        }
        let named: Named = super::typed(&label, table.clone())?;
        let set = dotted_leaves(&named.set);
        let set = set.into_iter().map(|(key, value)| (key, origin.clone(), value)).collect();
        let part = Part { name: named.name.to_string(), set };
        found.push((named, part));
    }
    Ok(found)
}

/// The axes of all layers; a later layer replaces the values of an earlier one.
fn axes(stack: &[Layer]) -> Result<Vec<Axis>, ConfigError> {
    let mut axes: Vec<Axis> = Vec::new();
    for Layer { origin, axes: own, .. } in stack {
        let own = match own {
            None => continue,
            Some(Value::Table(own)) => own,
            Some(value) => {
                let allowed = "a section of lists, such as \"env.noise\" = [0.5, 1.5]";
                return Err(rules::refused("experiment.axes", value, origin, allowed.into()));
            }
        };
        for (key, value) in dotted_leaves(own) {
            let full = format!("experiment.axes.{key}");
            let Value::Array(values) = &value else {
                if value.as_table().is_some_and(Table::is_empty) {
                    continue;
                }
                let allowed = "a list of the values that the option takes".to_owned();
                return Err(rules::refused(&full, &value, origin, allowed));
            };
            rules::check_set(&full, &value, origin)?;
            if let Some(value) = values.iter().find(|value| word(value).is_none()) {
                let allowed = "a number, a word, true or false, from which a variant gets its name; \
                               write other values into a [[experiment.variant]]";
                return Err(rules::refused(&full, value, origin, allowed.into()));
            }
            let axis = Axis { key, origin: origin.clone(), values: values.clone() };
            match axes.iter_mut().find(|earlier| earlier.key == axis.key) {
                Some(earlier) => *earlier = axis,
                None => axes.push(axis),
            }
        }
    }
    Ok(axes)
}

/// Every combination of the axes' values; one empty part if there are no axes.
fn combinations(axes: &[Axis]) -> Vec<Part> {
    axes.iter().fold(vec![Part::default()], |parts, axis| {
        let label = label(axis, axes);
        let extended = |part: &Part, value: &Value| {
            let mut part = part.clone();
            if !part.name.is_empty() {
                part.name += "+";
            }
            part.name += &format!("{label}-{}", word(value).unwrap_or_default());
            part.set.push((axis.key.clone(), axis.origin.clone(), value.clone()));
            part
        };
        let of = |part: &Part| axis.values.iter().map(|value| extended(part, value)).collect();
        parts.iter().flat_map(|part| -> Vec<Part> { of(part) }).collect()
    })
}

/// The shortest end of the axis's key that no other axis has.
fn label<'a>(axis: &'a Axis, axes: &[Axis]) -> &'a str {
    let key = axis.key.as_str();
    let ends = key.rmatch_indices('.').map(|(dot, _)| &key[dot + 1..]);
    let is_free = |end: &&str| {
        let others = axes.iter().filter(|other| other.key != axis.key);
        others
            .into_iter()
            .all(|other| other.key != **end && !other.key.ends_with(&format!(".{end}")))
    };
    ends.into_iter().find(is_free).unwrap_or(key)
}

/// A value as a part of a name.
fn word(value: &Value) -> Option<String> {
    match value {
        Value::Integer(number) => Some(number.to_string()),
        Value::Float(number) => Some(number.to_string()),
        Value::Boolean(flag) => Some(flag.to_string()),
        Value::String(word) => Some(word.clone()),
        _ => None,
    }
}
