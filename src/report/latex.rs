//! The table as LaTeX: one `table` environment per world and block, for `\input` in a paper that loads
//! `booktabs` and `graphicx`. Intervals stand below their values in small type; best values are bold;
//! what is wider than the text is scaled down.

use super::render::{self, Render, columns, row_headings, row_name, words};
use super::table::{Block, Table, World};

/// LaTeX with booktabs.
pub struct Latex;

impl Render for Latex {
    fn render(&self, table: &Table) -> String {
        let mut text =
            "% Needs \\usepackage{booktabs,graphicx}. Means over seeds with 95 % intervals.\n"
                .to_owned();
        for note in &table.notes {
            text += &format!("% {}\n", note.split_whitespace().collect::<Vec<_>>().join(" "));
        }
        for world in &table.worlds {
            for block in Block::ALL {
                text += &environment(table, world, block);
            }
        }
        text += "\n% Legend\n";
        for (term, meaning) in render::legend(table, "bold") {
            text += &format!("% {term}: {meaning}\n");
        }
        text
    }
}

fn environment(table: &Table, world: &World, block: Block) -> String {
    let columns = columns(world, block);
    if columns.is_empty() {
        return String::new();
    }
    let headings = row_headings(table);
    let titles =
        headings.iter().copied().chain(columns.iter().map(|(_, column)| world.heading(column)));
    let align: String =
        headings.iter().map(|&of| if Some(of) == table.heading { 'l' } else { 'r' }).collect();
    let mut lines = vec![titles.map(escaped).collect::<Vec<String>>()];
    for row in render::rows(world, &columns) {
        let (count, failed) = render::seeds(row);
        let mut values: Vec<String> =
            row_name(table, row).iter().map(|name| escaped(name)).chain([count]).collect();
        let mut below = vec![String::new(); headings.len() - 1];
        below.push(failed.as_deref().map_or(String::new(), small));
        for &(place, column) in &columns {
            let (value, interval) = words(column.format, row.cells[place]);
            let value = escaped(&value);
            values.push(if row.best[place] { format!("\\textbf{{{value}}}") } else { value });
            below.push(interval.as_deref().map_or(String::new(), small));
        }
        lines.push(values);
        if below.iter().any(|cell| !cell.is_empty()) {
            lines.push(below);
        }
    }
    let mut rows = lines.iter().map(|cells| format!("    {} \\\\\n", cells.join(" & ")));
    let header = rows.next().unwrap_or_default();
    format!(
        "\n\\begin{{table}}\n  \\centering\\footnotesize\\setlength{{\\tabcolsep}}{{3pt}}\n  \
         \\caption{{{}: {}.}}\n  \\label{{tab:{}-{}}}\n  \
         \\resizebox{{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}}{{!}}{{%\n  \
         \\begin{{tabular}}{{{align}{}}}\n    \\toprule\n{header}    \\midrule\n{}    \\bottomrule\n  \\end{{tabular}}}}\n\\end{{table}}\n",
        escaped(&world.name),
        escaped(&block.title(world)),
        label(&world.name),
        label(&format!("{block:?}").to_lowercase()),
        "r".repeat(columns.len()),
        rows.collect::<String>(),
    )
}

fn small(text: &str) -> String {
    format!("{{\\scriptsize {}}}", escaped(text))
}

/// A label takes no character that LaTeX reads.
fn label(name: &str) -> String {
    name.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect()
}

/// Plain text as LaTeX: symbols of the field in mathematics, numbers with a true minus.
fn escaped(text: &str) -> String {
    let mut out = String::new();
    for word in text.split_inclusive([' ', '[', ',']) {
        let (body, end) = match word.char_indices().next_back() {
            Some((place, end @ (' ' | '[' | ','))) => (&word[..place], end.to_string()),
            _ => (word, String::new()),
        };
        out += &match body {
            "eta" => "$\\eta$".to_owned(),
            "alpha" => "$\\alpha$".to_owned(),
            _ => match body.split_once('_') {
                Some(("CVaR", level)) => format!("CVaR$_{{{}}}$", level.replace("eta", "\\eta")),
                _ => characters(body),
            },
        };
        out += &end;
    }
    out
}

fn characters(word: &str) -> String {
    let mut out = String::new();
    for (place, character) in word.char_indices() {
        let number = word[place + character.len_utf8()..].starts_with(|c: char| c.is_ascii_digit());
        match character {
            '-' if number && place == 0 => out += "$-$",
            '–' => out += "--",
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(character);
            }
            '~' => out += "\\textasciitilde{}",
            '^' => out += "\\textasciicircum{}",
            '\\' => out += "\\textbackslash{}",
            '<' | '>' | '=' => out += &format!("${character}$"),
            other => out.push(other),
        }
    }
    out
}
