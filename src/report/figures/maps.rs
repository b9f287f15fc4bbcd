//! Maps of the two scenes, one panel for each eta.

use super::Panel;
use super::canvas::{
    Area, Drawn, FAINT, GOAL, INK, LAVA, TEXT, colour, figure, frame, heat, on, scale, short, text,
};
use crate::experiment::exhibits::{
    BINS_PER_METRE, BUDGET_CLASSES, Deviations, GridExhibit, PointExhibit, ShiftMap, WorldExhibit,
};
use lava_envs::{GridConfig, LavaGrid, PointConfig};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

/// Units of the canvas per cell or metre.
const UNIT: f64 = 44.0;
/// Space left of and above a map.
const MARGIN: (i32, i32) = (24, 60);
/// Height of the strip with the colours' scale.
const STRIP: i32 = 70;

/// Larger maps are not drawn.
const MOST_CELLS: usize = 10_000;

/// Cells with fewer steps say nothing about a probability (the paper's threshold).
const LEAST_VISITS: f64 = 500.0;
/// The same for a mean of noise: its standard error is then below 0.1.
const LEAST_STEPS: u64 = 100;

/// Where the maps of a figure lie: columns and rows of maps, each of so many cells or metres.
struct Layout {
    columns: usize,
    rows: usize,
    extent: (f64, f64),
    /// Height of the strip below them.
    strip: i32,
}

impl Layout {
    fn pitch(&self) -> (i32, i32) {
        let (width, height) = self.extent;
        ((width * UNIT) as i32 + 2 * MARGIN.0, (height * UNIT) as i32 + MARGIN.1 + 16)
    }

    fn size(&self) -> (u32, u32) {
        let (width, height) = self.pitch();
        ((width * self.columns as i32) as u32, (height * self.rows as i32 + self.strip) as u32)
    }

    fn origin(&self, column: usize, row: usize) -> (i32, i32) {
        let (width, height) = self.pitch();
        (width * column as i32 + MARGIN.0, height * row as i32 + MARGIN.1)
    }
}

/// A place in a map, or far outside of it.
fn at(origin: (i32, i32), x: f64, y: f64) -> (i32, i32) {
    let units = |length: f64| (length * UNIT).round().clamp(-1e6, 1e6) as i32;
    (origin.0 + units(x), origin.1 + units(y))
}

/// The world of a grid, if it is small enough for its cells to be seen.
fn visible(config: &GridConfig) -> Option<LavaGrid> {
    LavaGrid::new(config, 1).ok().filter(|grid| grid.cells() <= MOST_CELLS)
}

fn title(canvas: &Area, origin: (i32, i32), words: &str, colour: RGBColor) -> Drawn {
    let style = text(TEXT, colour, HPos::Left, VPos::Bottom);
    canvas.draw(&Text::new(words.to_owned(), (origin.0, origin.1 - 10), style))
}

/// Lava, goal, walls and the lines between cells, over whatever the cells show.
fn cells(canvas: &Area, grid: &LavaGrid, origin: (i32, i32)) -> Drawn {
    let (width, height) = (grid.width(), grid.height());
    for cell in 0..grid.cells() {
        let (x, y) = grid.coordinates(cell);
        let corners = [at(origin, x as f64, y as f64), at(origin, x as f64 + 1.0, y as f64 + 1.0)];
        let middle = at(origin, x as f64 + 0.5, y as f64 + 0.5);
        let centred = |colour| text(TEXT, colour, HPos::Center, VPos::Center);
        if grid.is_lava(cell) {
            canvas.draw(&Rectangle::new(corners, LAVA.filled()))?;
        } else if grid.is_wall(cell) {
            canvas.draw(&Rectangle::new(corners, INK.filled()))?;
        } else if grid.is_goal(cell) {
            canvas.draw(&Rectangle::new(corners, GOAL.filled()))?;
            canvas.draw(&Text::new("G", middle, centred(on(GOAL))))?;
        }
        canvas.draw(&frame(corners, FAINT.stroke_width(1)))?;
    }
    let corners = [origin, at(origin, width as f64, height as f64)];
    canvas.draw(&frame(corners, INK.stroke_width(3)))
}

/// Values of cells as colours with their numbers; `None` stays empty.
fn heat_map(
    canvas: &Area,
    grid: &LavaGrid,
    origin: (i32, i32),
    values: &[Option<f64>],
    greatest: f64,
) -> Drawn {
    for (cell, value) in values.iter().enumerate() {
        let Some(value) = value.filter(|_| !grid.is_lava(cell) && !grid.is_goal(cell)) else {
            continue;
        };
        let (x, y) = grid.coordinates(cell);
        let (x, y) = (x as f64, y as f64);
        let shade = heat(value / greatest);
        let corners = [at(origin, x, y), at(origin, x + 1.0, y + 1.0)];
        canvas.draw(&Rectangle::new(corners, shade.filled()))?;
        let style = text(19, on(shade), HPos::Center, VPos::Center);
        let number = format!("{value:.*}", if value < 10.0 { 2 } else { 0 });
        let number = number.strip_prefix('0').unwrap_or(&number).to_owned();
        canvas.draw(&Text::new(number, at(origin, x + 0.5, y + 0.5), style))?;
    }
    cells(canvas, grid, origin)
}

fn whole(grid: &LavaGrid) -> (f64, f64) {
    (grid.width() as f64, grid.height() as f64)
}

pub(super) fn grid(config: &GridConfig) -> Option<(String, String)> {
    let grid = visible(config)?;
    let layout = Layout { columns: 1, rows: 1, extent: whole(&grid), strip: 0 };
    let svg = figure(layout.size(), |canvas| {
        let origin = layout.origin(0, 0);
        cells(canvas, &grid, origin)?;
        let (x, y) = grid.coordinates(grid.start());
        let style = text(TEXT, INK, HPos::Center, VPos::Center);
        canvas.draw(&Text::new("S", at(origin, x as f64 + 0.5, y as f64 + 0.5), style))?;
        title(canvas, origin, "S start, G goal, orange lava", INK)
    })?;
    let GridConfig { slip, step_cost, goal_reward, lava_reward, horizon, .. } = config;
    let caption = format!(
        "The paper's Figure 2. A step costs {step_cost}, lava pays {lava_reward} and the goal {goal_reward}, \
         both of which end the episode; so does step {horizon}. With probability {slip} another than the \
         chosen move is executed."
    );
    Some((svg, caption))
}

/// The exhibits of a panel's seeds that are of the grid.
fn of_grid<'a>(panel: &'a Panel) -> impl Iterator<Item = &'a GridExhibit> {
    panel.archives.iter().filter_map(|(_, archive)| match &archive.exhibits.as_ref()?.world {
        WorldExhibit::LavaGrid(grid) => Some(grid),
        WorldExhibit::LavaPoint(_) => None,
    })
}

pub(super) fn occupancy(config: &GridConfig, panels: &[Panel]) -> Option<(String, String)> {
    let grid = visible(config)?;
    let mean = |panel: &Panel| -> Option<Vec<Option<f64>>> {
        let count = of_grid(panel).count() as f64;
        let sum = |cell: usize| of_grid(panel).filter_map(|of| of.occupancy.get(cell)).sum::<f64>();
        let seen = |cell| Some(sum(cell) / count).filter(|visits| *visits >= 0.005);
        (count > 0.0).then(|| (0..grid.cells()).map(seen).collect())
    };
    let maps: Vec<(&Panel, Vec<Option<f64>>)> =
        panels.iter().filter_map(|panel| Some((panel, mean(panel)?))).collect();
    if maps.is_empty() {
        return None;
    }
    let greatest = 1.0;
    let layout = Layout { columns: maps.len(), rows: 1, extent: whole(&grid), strip: STRIP };
    let svg = figure(layout.size(), |canvas| {
        for (column, (panel, values)) in maps.iter().enumerate() {
            let origin = layout.origin(column, 0);
            title(canvas, origin, &format!("eta = {}", panel.group.eta), INK)?;
            heat_map(canvas, &grid, origin, values, greatest)?;
        }
        strip(canvas, &layout, "visits per episode", ["0".to_owned(), "1 and more".to_owned()])
    })?;
    let caption = "The paper's Figure 3: expected visits of the greedy protagonist in an episode without slips \
                   (p = 0), averaged over seeds; exact. Empty cells: below 0.005.";
    Some((svg, caption.to_owned()))
}

fn strip(canvas: &Area, layout: &Layout, title: &str, ends: [String; 2]) -> Drawn {
    let top = layout.size().1 as i32 - STRIP;
    scale(&canvas.margin(top, 0, 0, 0), title, ends)
}

pub(super) fn deviations(config: &GridConfig, panels: &[Panel]) -> Option<(String, String)> {
    let grid = visible(config)?;
    let pooled = |panel: &Panel, of: fn(&GridExhibit) -> Option<&Deviations>| {
        let seeds: Vec<&Deviations> = of_grid(panel).filter_map(of).collect();
        let sum = |cell: usize, of: fn(&Deviations) -> &Vec<f64>| {
            seeds.iter().filter_map(|seed| of(seed).get(cell)).sum::<f64>()
        };
        let share = |cell| {
            let visits = sum(cell, |of| &of.visits);
            (visits >= LEAST_VISITS).then(|| sum(cell, |of| &of.deviations) / visits)
        };
        (!seeds.is_empty()).then(|| (0..grid.cells()).map(share).collect::<Vec<Option<f64>>>())
    };
    type Maps = Vec<Option<f64>>;
    let maps: Vec<(&Panel, [Maps; 2])> = (panels.iter())
        .filter_map(|panel| {
            let learned = pooled(panel, |of| of.learned.as_ref())?;
            Some((panel, [learned, pooled(panel, |of| of.exact.as_ref())?]))
        })
        .collect();
    let all = || maps.iter().flat_map(|(_, maps)| maps.iter().flatten().flatten());
    let greatest = all().copied().fold(config.slip, f64::max);
    if maps.is_empty() {
        return None;
    }
    let layout = Layout { columns: maps.len(), rows: 2, extent: whole(&grid), strip: STRIP };
    let svg = figure(layout.size(), |canvas| {
        for (column, (panel, maps)) in maps.iter().enumerate() {
            for (row, (name, values)) in
                ["learned", "exact worst case"].iter().zip(maps).enumerate()
            {
                let origin = layout.origin(column, row);
                title(canvas, origin, &format!("eta = {}, {name}", panel.group.eta), INK)?;
                heat_map(canvas, &grid, origin, values, greatest)?;
            }
        }
        strip(canvas, &layout, "P(deviation)", ["0".to_owned(), format!("{greatest:.2}")])
    })?;
    let episodes = (maps.iter())
        .find_map(|(panel, _)| panel.archives.iter().find_map(|(_, of)| of.exhibits.as_ref()))
        .map_or(0, |exhibits| exhibits.episodes);
    let caption = format!(
        "The paper's Figure 4: probability that the executed move is not the chosen one ({} without an \
         antagonist), greedy protagonist. Above against its learned antagonist, counted over {episodes} \
         trajectories per seed; below against the exact worst case, computed for the same policies. Seeds \
         pooled; cells with at least {LEAST_VISITS} visits.",
        config.slip
    );
    Some((svg, caption))
}

/// Lava, goal, start and border of the point mass's arena.
fn arena(canvas: &Area, config: &PointConfig, origin: (i32, i32)) -> Drawn {
    for (area, colour) in [(config.lava, LAVA), (config.goal, GOAL)] {
        let corners = [at(origin, area.min[0], area.min[1]), at(origin, area.max[0], area.max[1])];
        canvas.draw(&Rectangle::new(corners, colour.filled()))?;
    }
    let start = at(origin, config.start[0], config.start[1]);
    canvas.draw(&Circle::new(start, 7, INK.stroke_width(3)))?;
    let corners = [origin, at(origin, config.arena[0], config.arena[1])];
    canvas.draw(&frame(corners, INK.stroke_width(3)))
}

fn of_point<'a>(panel: &'a Panel) -> impl Iterator<Item = &'a PointExhibit> {
    panel.archives.iter().filter_map(|(_, archive)| match &archive.exhibits.as_ref()?.world {
        WorldExhibit::LavaPoint(point) => Some(point),
        WorldExhibit::LavaGrid(_) => None,
    })
}

pub(super) fn trajectories(config: &PointConfig, panels: &[Panel]) -> Option<(String, String)> {
    let shown: Vec<(usize, &Panel)> =
        panels.iter().enumerate().filter(|(_, panel)| of_point(panel).count() > 0).collect();
    if shown.is_empty() {
        return None;
    }
    let layout =
        Layout { columns: shown.len(), rows: 1, extent: config.arena.into(), strip: STRIP };
    let svg = figure(layout.size(), |canvas| {
        for (column, (place, panel)) in shown.iter().enumerate() {
            let origin = layout.origin(column, 0);
            title(canvas, origin, &format!("eta = {}", panel.group.eta), INK)?;
            arena(canvas, config, origin)?;
            for path in of_point(panel).flat_map(|of| &of.trajectories) {
                let line: Vec<(i32, i32)> = path.iter().map(|[x, y]| at(origin, *x, *y)).collect();
                canvas.draw(&PathElement::new(line, colour(*place).mix(0.5).stroke_width(2)))?;
            }
        }
        let note = "orange lava, green goal, circle start; lengths in metres";
        let style = text(TEXT, INK, HPos::Left, VPos::Center);
        let y = layout.size().1 as i32 - STRIP / 2;
        canvas.draw(&Text::new(note, (MARGIN.0, y), style))
    })?;
    let each = shown.iter().flat_map(|(_, panel)| of_point(panel)).map(|of| of.trajectories.len());
    let caption = format!(
        "Greedy protagonists of all seeds under nominal chance, the first {} episodes of each; all meet the \
         same noise.",
        each.max().unwrap_or_default()
    );
    Some((svg, caption))
}

/// The seeds' maps of one class as one, weighted by their steps.
fn pooled(panel: &Panel, class: usize) -> Option<ShiftMap> {
    let seeds: Vec<&ShiftMap> = of_point(panel).filter_map(|of| of.shifts.get(class)).collect();
    let bins = seeds.first()?.visits.len();
    let mut map = ShiftMap {
        visits: vec![0; bins],
        shift: vec![[0.0; 2]; bins],
        divergence: vec![0.0; bins],
    };
    for bin in 0..bins {
        let seeds = || seeds.iter().filter(|seed| seed.visits.get(bin).is_some_and(|n| *n > 0));
        let visits = seeds().map(|seed| seed.visits[bin]).fold(0, u64::saturating_add);
        let mean = |of: &dyn Fn(&ShiftMap) -> f64| {
            seeds().map(|seed| seed.visits[bin] as f64 * of(seed)).sum::<f64>()
                / visits.max(1) as f64
        };
        map.visits[bin] = visits;
        map.shift[bin] = [mean(&|seed| seed.shift[bin][0]), mean(&|seed| seed.shift[bin][1])];
        map.divergence[bin] = mean(&|seed| seed.divergence[bin]);
    }
    Some(map)
}

pub(super) fn shifts(config: &PointConfig, panels: &[Panel]) -> Option<(String, String)> {
    let maps: Vec<(&Panel, Vec<ShiftMap>)> = (panels.iter())
        .filter_map(|panel| {
            let classes: Option<Vec<ShiftMap>> =
                (0..BUDGET_CLASSES).map(|class| pooled(panel, class)).collect();
            Some((panel, classes?))
        })
        .collect();
    let bins = of_point(maps.first()?.0).next()?.bins;
    // What nearly all bins stay below; a few rare ones would take all the colours.
    let mut divergences: Vec<f64> = (maps.iter().flat_map(|(_, maps)| maps))
        .flat_map(|map| map.divergence.iter().zip(&map.visits))
        .filter(|(_, visits)| **visits >= LEAST_STEPS)
        .map(|(divergence, _)| *divergence)
        .collect();
    divergences.sort_by(f64::total_cmp);
    let greatest = *divergences.get(divergences.len().saturating_sub(1) * 98 / 100)?;
    let layout = Layout {
        columns: maps.len(),
        rows: BUDGET_CLASSES,
        extent: config.arena.into(),
        strip: STRIP,
    };
    let svg = figure(layout.size(), |canvas| {
        for (column, (panel, classes)) in maps.iter().enumerate() {
            for (class, map) in classes.iter().enumerate() {
                // The fullest purse on top: there an episode begins.
                let row = BUDGET_CLASSES - 1 - class;
                let origin = layout.origin(column, row);
                let share = |class: usize| short(class as f64 / BUDGET_CLASSES as f64);
                let range = if row == 0 {
                    format!("budget left: {} and more", share(class))
                } else {
                    format!("budget left: {} to {}", share(class), share(class + 1))
                };
                title(canvas, origin, &format!("eta = {}, {range}", panel.group.eta), INK)?;
                shift_map(canvas, origin, bins, map, greatest)?;
                arena(canvas, config, origin)?;
            }
        }
        let ends = ["0".to_owned(), format!("{greatest:.2} nats")];
        strip(canvas, &layout, "KL to nominal", ends)
    })?;
    let caption = format!(
        "How the learned antagonist bends the noise against the greedy protagonist, averaged over the steps \
         that began in a square of {} m (at least {LEAST_STEPS}), seeds pooled, by remaining budget log \
         eta_t / log eta. Arrow: mean of the noise xi, nominally 0; an arrow as long as a square is 1 \
         standard deviation. Colour: divergence of the bent law from the nominal one, the mean of log \
         delta_t(o_t).",
        1.0 / BINS_PER_METRE
    );
    Some((svg, caption))
}

fn shift_map(
    canvas: &Area,
    origin: (i32, i32),
    [width, height]: [usize; 2],
    map: &ShiftMap,
    greatest: f64,
) -> Drawn {
    let side = 1.0 / BINS_PER_METRE;
    for bin in 0..width.saturating_mul(height).min(map.visits.len()) {
        if map.visits[bin] < LEAST_STEPS {
            continue;
        }
        let (x, y) = ((bin % width) as f64 * side, (bin / width) as f64 * side);
        let shade = heat(map.divergence[bin] / greatest);
        let corners = [at(origin, x, y), at(origin, x + side, y + side)];
        canvas.draw(&Rectangle::new(corners, shade.filled()))?;
        let [dx, dy] = map.shift[bin].map(|shift| shift * side);
        let (x, y) = (x + side / 2.0, y + side / 2.0);
        arrow(canvas, origin, (x - dx / 2.0, y - dy / 2.0), (dx, dy), on(shade))?;
    }
    Ok(())
}

/// An arrow from a place, in the units of the map; too short for a head it is a line.
fn arrow(
    canvas: &Area,
    origin: (i32, i32),
    (x, y): (f64, f64),
    (dx, dy): (f64, f64),
    colour: RGBColor,
) -> Drawn {
    let tip = (x + dx, y + dy);
    let line = vec![at(origin, x, y), at(origin, tip.0, tip.1)];
    canvas.draw(&PathElement::new(line, colour.stroke_width(2)))?;
    let length = dx.hypot(dy);
    if length * UNIT < 6.0 {
        return Ok(());
    }
    let (ux, uy) = (dx / length * 0.14, dy / length * 0.14);
    let barb = |sign: f64| at(origin, tip.0 - ux + sign * uy * 0.6, tip.1 - uy - sign * ux * 0.6);
    let head = vec![barb(1.0), at(origin, tip.0, tip.1), barb(-1.0)];
    canvas.draw(&Polygon::new(head, colour.filled()))
}
