//! Formats of the table: terminal, Markdown, CSV and JSON, each from the one description in
//! [`super::table`].
//!
//! A further format is one more type with [`Render`]; [`Column`] gives it headings and meaning,
//! [`Cell`] the numbers, [`legend`] the words below.

use super::runs::{csv_text, number};
use super::statistics::{Estimate, Interval};
use super::table::{Block, COLUMNS, Cell, Column, Format, REGRET_TO_ORACLE, Row, Table, World};
use crate::experiment::artefacts::SCHEMA;
use comfy_table::{CellAlignment, LineStyle, TableStyle};
use serde_json::{Value, json};

/// Stands for a number that does not exist.
const MISSING: &str = "–";

/// Marks best values on a terminal.
const BEST: &str = "*";

/// Columns of text where there is no terminal, and the fewest and the most of one that are used.
const USUAL_WIDTH: usize = 100;
const WIDTHS: [usize; 2] = [80, 140];

/// Lines across, none down: a separator between columns would cost the width that intervals need.
const STYLE: TableStyle = TableStyle::new()
    .header_separator(LineStyle::none().fill('─'))
    .row_separator(LineStyle::none().fill('┈'));

/// A format of the table.
pub trait Render {
    /// The whole table as text.
    fn render(&self, table: &Table) -> String;
}

/// The columns of a block that have a number in this world.
pub(super) fn columns(world: &World, block: Block) -> Vec<(usize, &'static Column)> {
    let shown =
        |(place, column): &(usize, &Column)| column.blocks.contains(&block) && world.has(*place);
    COLUMNS.iter().enumerate().filter(shown).collect()
}

/// The rows that have a number in these columns, and all that were trained.
pub(super) fn rows<'a>(
    world: &'a World,
    columns: &'a [(usize, &'static Column)],
) -> impl Iterator<Item = &'a Row> {
    let number =
        |row: &Row| columns.iter().any(|&(place, _)| !matches!(row.cells[place], Cell::Missing));
    world.rows.iter().filter(move |row| !row.reference || number(row))
}

/// Headings of what stands before the columns: which row it is.
pub(super) fn row_headings(table: &Table) -> Vec<&'static str> {
    std::iter::once("eta").chain(table.heading).chain(["seeds"]).collect()
}

/// The cells below [`row_headings`], except the seeds, which [`seeds`] gives.
pub(super) fn row_name(table: &Table, row: &Row) -> Vec<String> {
    let name = table.heading.map(|_| row.name.clone());
    std::iter::once(row.eta.to_string()).chain(name).collect()
}

/// How the numbers came about, as terms and their meaning: columns shown, intervals, episodes, checks.
/// `mark` is what best values look like.
pub fn legend(table: &Table, mark: &str) -> Vec<(String, String)> {
    let mut legend = Vec::new();
    for (place, column) in COLUMNS.iter().enumerate() {
        if !column.blocks.is_empty() && table.worlds.iter().any(|world| world.has(place)) {
            legend.push((column.title.to_owned(), column.meaning.to_owned()));
        }
    }
    if table.worlds.iter().any(World::has_oracle) {
        let meaning = "the CVaR_1/eta of the oracle's certified controller minus that of the greedy protagonist: a better \
                       controller may exist, so that the regret itself is at least this much, up to sampling";
        legend.push((REGRET_TO_ORACLE.to_owned(), meaning.to_owned()));
    }
    let text = "[low, high] is a 95 % interval. Numbers are means over the seeds that do not fail (of all where every \
                seed fails), with Student t intervals that make room for skew (Hall) and for the sampling error which all \
                runs share; differences are paired by seed, with Student's t alone. Shares of seeds: Clopper and Pearson. Rates: never narrower than \
                Wilson's interval of all episodes. IQM: t of a trimmed mean (Yuen). P(better): Newcombe. `all`: with the \
                failures that the seeds allow. With one seed there is none. What they cover was simulated \
                (results/coverage.md)";
    legend.push(("intervals".to_owned(), text.to_owned()));
    let text = "does not exist for the row, or is a CVaR whose tail holds fewer than 10 episodes";
    legend.push((MISSING.to_owned(), text.to_owned()));
    if table.worlds.iter().flat_map(|world| &world.rows).any(|row| row.best.contains(&true)) {
        let text = "the best value of its column in the world, or one whose interval reaches into that \
                    of the best; what is measured at level 1/eta is compared within an eta alone. Rows with \
                    failed seeds are not marked";
        legend.push((mark.to_owned(), text.to_owned()));
    }
    if table.worlds.iter().flat_map(|world| &world.rows).any(|row| row.reference) {
        let text = "the best policy that is known at the row's eta, or at eta = 1: on lava-grid there is no better one \
                    (optimum); on lava-point it is a certified controller, and a better one may exist (oracle)";
        legend.push(("rows without seeds".to_owned(), text.to_owned()));
    }
    for world in &table.worlds {
        legend.push((world.name.clone(), format!("{}. {}", world.episodes, world.checks)));
    }
    legend
}

/// A cell in words: its value and what stands below or after it.
pub(super) fn words(format: Format, cell: Cell) -> (String, Option<String>) {
    let (decimals, factor) = match format {
        Format::Count => (0, 1.0),
        Format::Estimate(decimals) | Format::Worst(decimals) => (decimals, 1.0),
        Format::Percent => (2, 100.0),
    };
    let fixed = |value: f64| fixed(value * factor, decimals);
    match cell {
        Cell::Missing => (MISSING.to_owned(), None),
        Cell::Baseline => ("baseline".to_owned(), None),
        Cell::Count(count) => (count.to_string(), None),
        Cell::Worst { seed, value } => (fixed(value), Some(format!("seed {seed}"))),
        Cell::Estimate(estimate) => {
            let ends = |Interval { low, high }| format!("[{}, {}]", fixed(low), fixed(high));
            (fixed(estimate.value), estimate.interval.map(ends))
        }
    }
}

/// A number with so many decimals; no minus before a zero; minus infinity is a failed run.
fn fixed(value: f64, decimals: usize) -> String {
    if value == f64::NEG_INFINITY {
        return "failed".to_owned();
    }
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(digits) if digits.chars().all(|digit| matches!(digit, '0' | '.')) => digits.to_owned(),
        _ => text,
    }
}

pub(super) fn seeds(row: &Row) -> (String, Option<String>) {
    let failed = (row.failures > 0).then(|| format!("{} failed", row.failures));
    (if row.reference { String::new() } else { row.seeds.to_string() }, failed)
}

/// The columns of text of the terminal that standard output is, from 80 to 140; 100 where it is none.
pub fn screen_width() -> usize {
    let found = console::Term::stdout().size_checked();
    found.map_or(USUAL_WIDTH, |(_, width)| usize::from(width).clamp(WIDTHS[0], WIDTHS[1]))
}

/// For a terminal: values above their intervals. What is wider than the screen goes on below, and the words
/// are few; all of them are in the file that is written with it.
pub struct Terminal {
    /// Columns of text.
    pub width: usize,
    /// The file with the same table and all words.
    pub file: &'static str,
}

/// What the tables on a screen need words for.
#[derive(Default)]
struct Shown {
    columns: Vec<&'static Column>,
    interval: bool,
    missing: bool,
    best: bool,
}

impl Render for Terminal {
    fn render(&self, table: &Table) -> String {
        let mut text = String::new();
        let mut shown = Shown::default();
        for world in &table.worlds {
            // The others are for reading at leisure.
            for block in [Block::Returns, Block::Game, Block::Comparison] {
                let columns = columns(world, block);
                if !columns.is_empty() {
                    text += &self.block(table, world, &block.title(world), &columns, &mut shown);
                }
            }
        }
        text += &wrapped(&self.legend(&shown), self.width, "", 0);
        // Last, where the eye is when a long output has scrolled by.
        for note in &table.notes {
            text += &wrapped(note, self.width, "\n! ", 2);
        }
        text
    }
}

impl Terminal {
    /// One block of a world, in as many pieces below each other as the width needs.
    fn block(
        &self,
        table: &Table,
        world: &World,
        title: &str,
        columns: &[(usize, &'static Column)],
        shown: &mut Shown,
    ) -> String {
        let name_width = (self.width / 3).max(1);
        let mut head: Vec<Vec<String>> =
            vec![row_headings(table).into_iter().map(str::to_owned).collect()];
        let rows: Vec<&Row> = rows(world, columns).collect();
        for row in &rows {
            let (count, failed) = seeds(row);
            let count = failed.map_or(count.clone(), |failed| format!("{count}\n{failed}"));
            let name = row_name(table, row).into_iter().map(|name| folded(&name, name_width));
            head.push(name.chain([count]).collect());
        }
        let cells = |&(place, column): &(usize, &'static Column)| -> Vec<String> {
            let cell = |row: &&Row| {
                let (value, below) = words(column.format, row.cells[place]);
                let value = value + if row.best[place] { BEST } else { "" };
                below.map_or(value.clone(), |below| format!("{value}\n{below}"))
            };
            std::iter::once(world.heading(column).to_owned()).chain(rows.iter().map(cell)).collect()
        };
        let columns: Vec<(usize, &'static Column, Vec<String>)> =
            columns.iter().map(|of| (of.0, of.1, cells(of))).collect();
        for (place, column, _) in &columns {
            for row in &rows {
                shown.best |= row.best[*place];
                shown.missing |= row.cells[*place] == Cell::Missing;
                shown.interval |=
                    matches!(row.cells[*place], Cell::Estimate(Estimate { interval: Some(_), .. }));
            }
            shown.columns.push(column);
        }
        // A space on either side of each column.
        let wide = |cells: &[String]| {
            let lines = cells.iter().flat_map(|cell| cell.lines());
            lines.map(|line| line.chars().count()).max().unwrap_or_default() + 2
        };
        let before: usize = (0..head[0].len())
            .map(|place| wide(&head.iter().map(|line| line[place].clone()).collect::<Vec<_>>()))
            .sum();
        let widths: Vec<usize> = columns.iter().map(|(_, _, cells)| wide(cells)).collect();
        // The last space is not printed.
        let lengths = balanced(&widths, (self.width + 1).saturating_sub(before));
        let mut rest = columns.iter().map(|(_, _, cells)| cells);
        let pieces: Vec<Vec<&Vec<String>>> =
            lengths.iter().map(|length| rest.by_ref().take(*length).collect()).collect();
        let mut text = String::new();
        for (number, piece) in pieces.iter().enumerate() {
            let mut drawn = comfy_table::Table::new();
            drawn.load_style(STYLE);
            for (place, head) in head.iter().enumerate() {
                let line = head.iter().chain(piece.iter().map(|cells| &cells[place]));
                if place == 0 {
                    drawn.set_header(line);
                } else {
                    drawn.add_row(line);
                }
            }
            for column in drawn.column_iter_mut() {
                column.set_cell_alignment(CellAlignment::Right);
            }
            let more = if number > 0 { ", continued" } else { "" };
            text += &format!("{}: {title}{more}\n{}\n\n", world.name, drawn.trim_fmt());
        }
        text
    }

    /// The words below the tables.
    fn legend(&self, shown: &Shown) -> String {
        let mut said: Vec<String> = Vec::new();
        for column in &shown.columns {
            let text = format!("{}: {}.", column.title, column.brief);
            if !column.brief.is_empty() && !said.contains(&text) {
                said.push(text);
            }
        }
        if shown.interval {
            said.push("[low, high]: 95 % interval over seeds.".to_owned());
        }
        if shown.best {
            said.push(format!("{BEST}: the best, or not distinguishable from it."));
        }
        if shown.missing {
            said.push(format!("{MISSING}: no number, or too few episodes for it."));
        }
        said.push(format!("{} explains every column.", self.file));
        said.join(" ")
    }
}

/// How many columns of these widths go into each of the fewest pieces that fit into `width`, the widest of
/// which is as narrow as can be. A column that is wider than that has a piece of its own.
fn balanced(widths: &[usize], width: usize) -> Vec<usize> {
    let pieces = |limit: usize| {
        let mut pieces: Vec<usize> = Vec::new();
        let mut used = 0;
        for width in widths {
            used += width;
            match pieces.last_mut() {
                Some(last) if used <= limit => *last += 1,
                _ => {
                    pieces.push(1);
                    used = *width;
                }
            }
        }
        pieces
    };
    let fewest = pieces(width);
    let narrower = (0..width).map(pieces).find(|found| found.len() == fewest.len());
    narrower.unwrap_or(fewest)
}

/// A name on lines of at most so many characters, broken after its separators where it can be.
fn folded(name: &str, width: usize) -> String {
    let mut lines = vec![String::new()];
    for part in name.split_inclusive(['/', '+', ' ', ',']) {
        let last = lines.last_mut().expect("there is one");
        let needed = last.chars().count() + part.trim_end().chars().count();
        if !last.is_empty() && needed > width {
            lines.push(String::new());
        }
        for character in part.chars() {
            if lines.last().expect("there is one").chars().count() == width {
                lines.push(String::new());
            }
            lines.last_mut().expect("there is one").push(character);
        }
    }
    lines.iter().map(|line| line.trim_end()).collect::<Vec<_>>().join("\n")
}

/// Running text broken at words, after `first` and with later lines moved in.
fn wrapped(text: &str, width: usize, first: &str, indent: usize) -> String {
    let mut out = first.to_owned();
    let mut length = indent;
    for (place, word) in text.split_whitespace().enumerate() {
        let needed = word.chars().count() + usize::from(place > 0);
        if place > 0 && length + needed > width {
            out += &format!("\n{}{word}", " ".repeat(indent));
            length = indent + word.chars().count();
            continue;
        }
        if place > 0 {
            out.push(' ');
        }
        out += word;
        length += needed;
    }
    out.push('\n');
    out
}

/// GitHub's Markdown, padded so that it reads as plain text too.
pub struct Markdown;

impl Render for Markdown {
    fn render(&self, table: &Table) -> String {
        let mut text = "# Results\n".to_owned();
        for note in &table.notes {
            text += &format!("\n> {}\n", escaped(note));
        }
        for world in &table.worlds {
            text += &format!("\n## {}\n", world.name);
            for block in Block::ALL {
                let title = block.title(world);
                let columns = columns(world, block);
                if columns.is_empty() {
                    continue;
                }
                let titles = columns.iter().map(|(_, column)| world.heading(column));
                let mut lines: Vec<Vec<String>> = vec![
                    row_headings(table).into_iter().chain(titles).map(str::to_owned).collect(),
                ];
                for row in rows(world, &columns) {
                    let cells = columns.iter().map(|&(place, column)| {
                        let (value, after) = words(column.format, row.cells[place]);
                        let value = if row.best[place] { format!("**{value}**") } else { value };
                        after.map_or(value.clone(), |after| format!("{value} {after}"))
                    });
                    let (count, failed) = seeds(row);
                    let count =
                        failed.map_or(count.clone(), |failed| format!("{count} ({failed})"));
                    let name = row_name(table, row).into_iter().map(|name| escaped(&name));
                    lines.push(name.chain([count]).chain(cells).collect());
                }
                text +=
                    &format!("\n{}{}:\n\n{}", title[..1].to_uppercase(), &title[1..], grid(&lines));
            }
        }
        text += "\n## Legend\n\n";
        for (term, meaning) in legend(table, "bold") {
            text += &format!("- **{term}**: {}\n", escaped(&meaning));
        }
        text
    }
}

/// Lines of cells, the first being the header, as a padded Markdown table.
fn grid(lines: &[Vec<String>]) -> String {
    let count = |cell: &String| cell.chars().count();
    let widths: Vec<usize> = (0..lines[0].len())
        .map(|place| lines.iter().map(|line| count(&line[place])).max().unwrap_or_default().max(4))
        .collect();
    let mut text = String::new();
    for (number, line) in lines.iter().enumerate() {
        for (cell, width) in line.iter().zip(&widths) {
            text += &format!("| {cell:>width$} ");
        }
        text += "|\n";
        if number == 0 {
            for width in &widths {
                text += &format!("| {}: ", "-".repeat(width - 1));
            }
            text += "|\n";
        }
    }
    text
}

/// Keeps what a failure says from being read as Markdown.
fn escaped(text: &str) -> String {
    let line = text.split_whitespace().collect::<Vec<&str>>().join(" ");
    line.replace('<', "&lt;").replace('*', "\\*").replace('`', "\\`")
}

/// CSV: `env,eta,alpha,seeds,failures` (after `folder` or `method`, if there are several), then every
/// column by its key; an estimate has `KEY`, `KEY_lo` and `KEY_hi`, the worst seed `KEY` and `KEY_seed`.
/// Rates are fractions. Six decimals; empty where there is no number. A few columns are left out where no row
/// has a number ([`Table::lists`]).
pub struct Csv;

impl Render for Csv {
    fn render(&self, table: &Table) -> String {
        let mut header = ["env", "eta", "alpha", "seeds", "failures"].map(str::to_owned).to_vec();
        if let Some(heading) = table.heading {
            header.insert(0, heading.to_owned());
        }
        let listed = || COLUMNS.iter().enumerate().filter(|(place, _)| table.lists(*place));
        for (_, Column { key, format, .. }) in listed() {
            header.push((*key).to_owned());
            match format {
                Format::Count => {}
                Format::Worst(_) => header.push(format!("{key}_seed")),
                Format::Estimate(_) | Format::Percent => {
                    header.extend([format!("{key}_lo"), format!("{key}_hi")]);
                }
            }
        }
        let rows = table.worlds.iter().flat_map(|world| {
            world.rows.iter().map(|row| {
                let mut fields = vec![
                    world.name.clone(),
                    row.eta.to_string(),
                    number(Some(1.0 / row.eta)),
                    row.seeds.to_string(),
                    row.failures.to_string(),
                ];
                if table.heading.is_some() {
                    fields.insert(0, row.name.clone());
                }
                for (place, column) in listed() {
                    let cell = row.cells[place];
                    let width = match column.format {
                        Format::Count => 1,
                        Format::Worst(_) => 2,
                        Format::Estimate(_) | Format::Percent => 3,
                    };
                    let end = fields.len() + width;
                    match cell {
                        Cell::Missing | Cell::Baseline => {}
                        Cell::Count(count) => fields.push(count.to_string()),
                        Cell::Worst { seed, value } => {
                            fields.extend([number(Some(value)), seed.to_string()]);
                        }
                        Cell::Estimate(estimate) => {
                            fields.push(number(Some(estimate.value)));
                            fields.push(number(estimate.interval.map(|interval| interval.low)));
                            fields.push(number(estimate.interval.map(|interval| interval.high)));
                        }
                    }
                    fields.resize(end, String::new());
                }
                fields
            })
        });
        csv_text(std::iter::once(header).chain(rows))
    }
}

/// JSON: `{schema, columns: {KEY: {title, meaning}}, worlds: [{env, episodes, checks, rows: [{folder,
/// method, variant, settings, reference, eta, alpha, seeds, failures, KEY: ..}]}], notes}`. A reference is a policy that
/// no method trained. An estimate is `{value, low,
/// high}`, the worst seed `{value, seed}`, a count a number; `null` where there is no number, no variant or no
/// other settings.
pub struct Json;

impl Json {
    /// The table as a value.
    pub fn value(&self, table: &Table) -> Value {
        let finite = |value: f64| Some(value).filter(|value| value.is_finite());
        let cell = |cell: Cell| match cell {
            Cell::Missing | Cell::Baseline => Value::Null,
            Cell::Count(count) => json!(count),
            Cell::Worst { seed, value } => json!({ "value": finite(value), "seed": seed }),
            Cell::Estimate(estimate) => json!({
                "value": finite(estimate.value),
                "low": estimate.interval.and_then(|interval| finite(interval.low)),
                "high": estimate.interval.and_then(|interval| finite(interval.high)),
            }),
        };
        let row = |row: &Row| {
            let mut value = json!({
                "folder": row.folder,
                "method": row.method,
                "variant": row.variant,
                "settings": row.settings,
                "reference": row.reference,
                "eta": row.eta,
                "alpha": 1.0 / row.eta,
                "seeds": row.seeds,
                "failures": row.failures,
            });
            for (column, &content) in COLUMNS.iter().zip(&row.cells) {
                value[column.key] = cell(content);
            }
            value
        };
        let worlds = table.worlds.iter().map(|world| {
            json!({
                "env": world.name,
                "episodes": world.episodes,
                "checks": world.checks,
                "rows": world.rows.iter().map(row).collect::<Vec<Value>>(),
            })
        });
        let columns: serde_json::Map<String, Value> = (COLUMNS.iter())
            .map(|column| {
                let said = json!({ "title": column.title, "meaning": column.meaning });
                (column.key.to_owned(), said)
            })
            .collect();
        json!({
            "schema": SCHEMA,
            "columns": columns,
            "worlds": worlds.collect::<Vec<Value>>(),
            "notes": table.notes,
        })
    }
}

impl Render for Json {
    fn render(&self, table: &Table) -> String {
        format!("{:#}\n", self.value(table))
    }
}

#[cfg(test)]
mod tests {
    use super::{balanced, folded, wrapped};

    #[test]
    fn columns_are_spread_over_the_fewest_pieces() {
        assert_eq!(balanced(&[10, 10, 10, 10], 40), [4]);
        assert_eq!(balanced(&[10, 10, 10, 10], 39), [2, 2]);
        assert_eq!(balanced(&[10, 10, 10, 10], 1), [1, 1, 1, 1]);
        assert_eq!(balanced(&[5, 50, 5], 20), [1, 1, 1]);
    }

    #[test]
    fn names_and_notes_are_broken_at_words() {
        assert_eq!(folded("game/k-1, slip=0.05", 10), "game/k-1,\nslip=0.05");
        assert_eq!(folded("abcdefgh", 3), "abc\ndef\ngh");
        assert_eq!(wrapped("one two three", 9, "! ", 2), "! one two\n  three\n");
    }
}
