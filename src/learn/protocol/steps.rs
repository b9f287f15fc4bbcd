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
//! | `end` | goal, lava, timeout, or nothing | the same |

use super::evaluation::{self, Request, Yardstick};
use super::failure::RunError;
use crate::contest::{Contest, Outcome};
use crate::play::Watcher;
use cvar_game::experiment::artefacts::Mode;
use cvar_game::experiment::config::{RunConfig, WorldConfig};
use lava_envs::{End, Force, LavaGrid, LavaPoint, Move, World};
use nalgebra::Vector2;
use serde::ser::{Serialize, SerializeMap, Serializer};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

/// Which rollout is wanted.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    /// How the protagonist picks its actions.
    pub mode: Mode,
    /// Against whom, how many and on which streams.
    pub request: Request,
    /// Format of the rows.
    pub format: Format,
}

/// Format of the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A table with a head.
    Csv,
    /// An object per line.
    Json,
}

/// Plays episodes with the finished run in `folder` and writes a row per step, by episode and time.
///
/// # Errors
/// If the folder holds no finished run, the request makes no sense for it, or the output takes no more.
pub fn write_rollout(
    folder: &Path,
    wanted: &Wanted,
    output: &mut dyn Write,
) -> Result<(), RunError> {
    let mut run = wanted.request.load(folder)?;
    // Rows wait in memory for those of earlier episodes.
    run.evaluation.parallel_episodes = run.evaluation.parallel_episodes.min(256);
    match &run.env {
        WorldConfig::LavaGrid(constants) => {
            write::<LavaGrid>(&run, constants, folder, wanted, output)
        }
        WorldConfig::LavaPoint(constants) => {
            write::<LavaPoint>(&run, constants, folder, wanted, output)
        }
    }
}

fn write<W: Recorded>(
    run: &RunConfig,
    constants: &W::Constants,
    folder: &Path,
    wanted: &Wanted,
    output: &mut dyn Write,
) -> Result<(), RunError> {
    let pair = evaluation::load::<W>(run, folder)?;
    let mut rows = Rows {
        states: vec![Vec::new(); run.evaluation.parallel_episodes],
        waiting: BTreeMap::new(),
        next: 0,
        writer: Writer { format: wanted.format, output, begun: false },
        failure: None,
    };
    let request = wanted.request;
    evaluation::play_run(run, constants, &pair, wanted.mode, request.chance, &mut rows)?;
    rows.failure.map_or(Ok(()), |error| Err(RunError::Output(error)))?;
    output.flush().map_err(RunError::Output)
}

/// A world whose steps can be written.
trait Recorded: Yardstick {
    fn state(&self, slot: usize) -> Vec<(&'static str, Cell)>;
    fn action(action: Self::Action) -> Vec<(&'static str, Cell)>;
    fn outcome(outcome: Outcome<Self>) -> Vec<(&'static str, Cell)>;
}

impl Recorded for LavaGrid {
    fn state(&self, slot: usize) -> Vec<(&'static str, Cell)> {
        let [x, y] = self.position(slot);
        vec![("x", Cell::Number(x)), ("y", Cell::Number(y))]
    }

    fn action(action: Move) -> Vec<(&'static str, Cell)> {
        vec![("action", Cell::Word(action.name()))]
    }

    fn outcome(outcome: usize) -> Vec<(&'static str, Cell)> {
        vec![("executed", Cell::Word(Move::from_index(outcome).name()))]
    }
}

impl Recorded for LavaPoint {
    fn state(&self, slot: usize) -> Vec<(&'static str, Cell)> {
        let ([x, y], [vx, vy]) = (self.position(slot), self.velocity(slot));
        [("x", x), ("y", y), ("vx", vx), ("vy", vy)].map(|(name, x)| (name, Cell::Number(x))).into()
    }

    fn action(Force(action): Force) -> Vec<(&'static str, Cell)> {
        vec![("action_x", Cell::Number(action.x)), ("action_y", Cell::Number(action.y))]
    }

    fn outcome(xi: Vector2<f64>) -> Vec<(&'static str, Cell)> {
        vec![("xi_x", Cell::Number(xi.x)), ("xi_y", Cell::Number(xi.y))]
    }
}

/// A field of a row.
#[derive(Debug, Clone, Copy)]
enum Cell {
    Count(u64),
    Number(f64),
    Word(&'static str),
    Nothing,
}

impl Serialize for Cell {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match *self {
            Cell::Count(count) => serializer.serialize_u64(count),
            Cell::Number(number) => serializer.serialize_f64(number),
            Cell::Word(word) => serializer.serialize_str(word),
            Cell::Nothing => serializer.serialize_none(),
        }
    }
}

/// One step: names and fields in the order of the columns.
#[derive(Debug)]
struct Row(Vec<(&'static str, Cell)>);

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
    states: Vec<Vec<(&'static str, Cell)>>,
    /// Episodes that are being played, or that wait for an earlier one: rows, and whether it ended.
    waiting: BTreeMap<usize, (Vec<Row>, bool)>,
    /// The episode to be written next.
    next: usize,
    writer: Writer<'a>,
    failure: Option<io::Error>,
}

impl<W: Recorded> Watcher<W> for Rows<'_> {
    fn before(&mut self, world: &W, slot: usize) {
        self.states[slot] = world.state(slot);
    }

    fn after(&mut self, contest: &Contest<W>, slot: usize, episode: usize) {
        let (rows, ended) = self.waiting.entry(episode).or_default();
        let step = contest.steps[slot];
        let end = step.end.map_or(Cell::Nothing, |end| {
            Cell::Word(match end {
                End::Goal => "goal",
                End::Lava => "lava",
                End::Timeout => "timeout",
            })
        });
        let clearance = contest.world.clearance(slot);
        let mut row =
            vec![("episode", Cell::Count(episode as u64)), ("t", Cell::Count(rows.len() as u64))];
        row.append(&mut self.states[slot]);
        row.extend(W::action(contest.actions[slot]));
        row.extend(W::outcome(contest.outcomes[slot]));
        row.extend([
            ("delta", Cell::Number(contest.ratios[slot])),
            ("budget", Cell::Number(contest.budgets_before[slot].get())),
            ("reward", Cell::Number(step.reward)),
            // A map without lava has no distance to it.
            (
                "clearance",
                if clearance.is_finite() { Cell::Number(clearance) } else { Cell::Nothing },
            ),
            ("end", end),
        ]);
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

    /// An output that takes no more takes none of what would follow.
    fn has_enough(&self) -> bool {
        self.failure.is_some()
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
                    csv.write_record(row.0.iter().map(|(name, _)| name))?;
                    self.begun = true;
                }
                csv.serialize(row.0.iter().map(|(_, cell)| cell).collect::<Vec<_>>())?;
                csv.flush()
            }
        }
    }
}
