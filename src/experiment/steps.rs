//! Rollouts as data: every step of the episodes of a trained pair, a row each.
//!
//! | column | lava-grid | lava-point |
//! |---|---|---|
//! | `episode`, `t` | index of the episode and time, both from 0 | the same |
//! | state before the step | `x`, `y` in cells | `x`, `y` in m, `vx`, `vy` in m/s |
//! | chosen action | `action`: up, down, right or left | `action_x`, `action_y`, not yet scaled onto the unit disc |
//! | outcome o_t | `executed`: the move | `xi_x`, `xi_y`: the noise, in standard deviations |
//! | `delta` | likelihood ratio delta_t(o_t) | the same |
//! | `budget` | remaining budget eta_t before the step | the same |
//! | `reward` | r_t | the same |
//! | `clearance` | distance to lava after the step, in cells | in m |
//! | `end` | goal, lava, timeout, or empty | the same |
//! | state after the step | `next_x`, `next_y` | `next_x`, `next_y`, `next_vx`, `next_vy` |

use super::artefacts::Chance;
use super::evaluation::Contestants;
use super::failure::RunError;
use crate::exact::yardstick::Solvable;
use crate::game::returns::ReturnSoFar;
use crate::learn::method::Arena;
use crate::learn::play::Watcher;
use crate::learn::policy::Mode;
use crate::learn::vector_game::VectorGame;
use lava_envs::{End, Field, World};
use serde::ser::{Serialize, SerializeMap, Serializer};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Most episodes that are played at a time: their rows wait in memory for those of earlier episodes.
pub const MOST_PARALLEL: usize = 256;

/// Format of the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// A table with a header.
    Csv,
    /// An object per line.
    Json,
}

/// Plays the episodes of the run's configuration and writes a row per step, by episode and time.
///
/// # Errors
/// If the request makes no sense for the run, or the output cannot be written to.
pub fn write_rollout<W: Arena + Solvable>(
    contestants: &Contestants<'_, W>,
    mode: Mode,
    chance: Chance,
    format: Format,
    output: &mut dyn Write,
) -> Result<(), RunError> {
    let mut rows = Rows {
        states: vec![Vec::new(); contestants.run.evaluation.parallel_episodes],
        waiting: BTreeMap::new(),
        next: 0,
        writer: Writer { format, output, begun: false },
        failure: None,
    };
    contestants.play(mode, chance, &mut rows)?;
    rows.failure.map_or(Ok(()), |error| Err(RunError::Output(error)))?;
    rows.writer.output.flush().map_err(RunError::Output)
}

/// One step: names and fields in the order of the columns.
#[derive(Debug)]
struct Row(Vec<(Cow<'static, str>, Field)>);

impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, cell) in &self.0 {
            map.serialize_entry(name, cell)?;
        }
        map.end()
    }
}

/// Puts the steps of interleaved episodes in order.
struct Rows<'a> {
    /// The state of each slot before its step.
    states: Vec<Vec<(&'static str, Field)>>,
    /// Episodes that are being played, or that wait for an earlier one: rows, and whether it ended.
    waiting: BTreeMap<usize, (Vec<Row>, bool)>,
    /// The episode to be written next.
    next: usize,
    writer: Writer<'a>,
    failure: Option<io::Error>,
}

impl<W: World> Watcher<W> for Rows<'_> {
    fn before(&mut self, world: &W, slot: usize) {
        self.states[slot] = world.state_columns(slot);
    }

    fn after(&mut self, game: &VectorGame<W>, slot: usize, episode: usize, _: &ReturnSoFar) {
        let (rows, ended) = self.waiting.entry(episode).or_default();
        let step = game.steps[slot];
        let end = step.end.map_or(Field::Empty, |end| {
            Field::Word(match end {
                End::Goal => "goal",
                End::Lava => "lava",
                End::Timeout => "timeout",
            })
        });
        let clearance = game.world.clearance(slot);
        let mut row: Vec<(&'static str, Field)> =
            vec![("episode", Field::Count(episode as u64)), ("t", Field::Count(rows.len() as u64))];
        row.append(&mut self.states[slot]);
        row.extend(W::action_columns(game.actions[slot]));
        row.extend(W::outcome_columns(game.outcomes[slot]));
        row.extend([
            ("delta", Field::Number(game.likelihood_ratio(slot))),
            ("budget", Field::Number(game.budgets_at_draw[slot].get())),
            ("reward", Field::Number(step.reward)),
            // A map without lava has no distance to it.
            (
                "clearance",
                if clearance.is_finite() { Field::Number(clearance) } else { Field::Empty },
            ),
            ("end", end),
        ]);
        let mut row: Vec<_> = row.into_iter().map(|(name, cell)| (name.into(), cell)).collect();
        let next = game.world.state_columns(slot).into_iter();
        row.extend(next.map(|(name, cell)| (format!("next_{name}").into(), cell)));
        rows.push(Row(row));
        *ended = step.end.is_some();
        while let Some(first) = self.waiting.first_entry()
            && *first.key() == self.next
            && first.get().1
        {
            for row in first.remove().0 {
                if self.failure.is_none() {
                    self.failure = self.writer.write(&row).err();
                }
            }
            self.next += 1;
        }
    }

    /// After the output has failed, no further step is of use.
    fn has_enough(&self) -> bool {
        self.failure.is_some()
    }

    /// They are in the rows.
    fn keeps_episodes(&self) -> bool {
        false
    }
}

struct Writer<'a> {
    format: Format,
    output: &'a mut dyn Write,
    begun: bool,
}

impl Writer<'_> {
    fn write(&mut self, row: &Row) -> io::Result<()> {
        match self.format {
            Format::Json => {
                serde_json::to_writer(&mut *self.output, row)?;
                self.output.write_all(b"\n")
            }
            Format::Csv => {
                let mut csv = csv::Writer::from_writer(&mut *self.output);
                if !self.begun {
                    csv.write_record(row.0.iter().map(|(name, _)| name.as_ref()))?;
                    self.begun = true;
                }
                csv.serialize(row.0.iter().map(|(_, cell)| cell).collect::<Vec<_>>())?;
                csv.flush()
            }
        }
    }
}
