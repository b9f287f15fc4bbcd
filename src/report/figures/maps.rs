//! Maps of the scene, one panel for each row of the table: heat maps of worlds of cells, trajectories and
//! shifted noise of worlds in the plane.

use super::Panel;
use super::canvas::{
    Area, Drawn, FAINT, GOAL, INK, LAVA, LESSER_GOAL, Picture, TEXT, colour, figure, frame, heat,
    on, scale, short, text,
};
use crate::experiment::figure_data::{
    BUDGET_CLASSES, CellData, Deviations, MOST_CELLS, PlaneData, ShiftMap, WorldData,
};
use lava_envs::scene::{Area as Place, AreaKind, Scene};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

/// Least width of a figure with a strip: its words need it.
const NARROWEST: i32 = 640;

/// Units of the canvas per cell, and per metre of a plane that is not large.
const UNIT: f64 = 44.0;
/// Units of the canvas of the longer side of a large plane.
const LARGEST: f64 = 2_000.0;
/// Space left of and above a map.
const MARGIN: (i32, i32) = (24, 60);
/// Height of the strip with the colours' scale.
const STRIP: i32 = 70;

/// Planes with a longer side are not drawn.
const LONGEST_SIDE: f64 = 1_000.0;

/// With fewer steps in a cell, a probability is not shown (the paper's threshold).
const LEAST_VISITS: f64 = 500.0;
/// The same for a mean of noise: its standard error is then below 0.1.
const LEAST_STEPS: u64 = 100;

/// Where the maps of a figure lie: columns and rows of maps, each of so many cells or metres.
struct Layout {
    columns: usize,
    rows: usize,
    extent: (f64, f64),
    /// Units of the canvas per cell or metre.
    unit: f64,
    /// Height of the strip below them.
    strip: i32,
}

/// The corner of a map on the canvas.
#[derive(Clone, Copy)]
struct Origin {
    x: i32,
    y: i32,
    unit: f64,
}

/// The column and the row of each panel: those of one method are beside each other.
fn places<'a>(panels: impl Iterator<Item = &'a Panel<'a>>) -> Vec<(usize, usize)> {
    let mut places: Vec<(usize, usize)> = Vec::new();
    let mut last: Option<&Panel> = None;
    for panel in panels {
        let (column, row) = places.last().copied().unwrap_or_default();
        places.push(match last {
            None => (0, 0),
            Some(last) if last.group.method == panel.group.method => (column + 1, row),
            Some(_) => (0, row + 1),
        });
        last = Some(panel);
    }
    places
}

/// A layout of panels in these places, each of `rows` maps one below the other, in a scene.
fn layout(scene: &Scene, places: &[(usize, usize)], rows: usize) -> Layout {
    let columns = places.iter().map(|(column, _)| column + 1).max().unwrap_or(1);
    let blocks = places.iter().map(|(_, row)| row + 1).max().unwrap_or(1);
    let longest = scene.size[0].max(scene.size[1]);
    let unit = if scene.cells { UNIT } else { UNIT.min(LARGEST / longest) };
    Layout { columns, rows: blocks * rows, extent: scene.size.into(), unit, strip: STRIP }
}

impl Layout {
    fn pitch(&self) -> (i32, i32) {
        let (width, height) = self.extent;
        let unit = self.unit;
        ((width * unit) as i32 + 2 * MARGIN.0, (height * unit) as i32 + MARGIN.1 + 16)
    }

    fn size(&self) -> (u32, u32) {
        let (width, height) = self.pitch();
        let least = if self.strip > 0 { NARROWEST } else { 0 };
        let width = (width * self.columns as i32).max(least);
        (width as u32, (height * self.rows as i32 + self.strip) as u32)
    }

    fn origin(&self, column: usize, row: usize) -> Origin {
        let (width, height) = self.pitch();
        let (x, y) = (width * column as i32 + MARGIN.0, height * row as i32 + MARGIN.1);
        Origin { x, y, unit: self.unit }
    }
}

/// A place in a map, or far outside of it.
fn at(origin: Origin, x: f64, y: f64) -> (i32, i32) {
    let units = |length: f64| (length * origin.unit).round().clamp(-1e6, 1e6) as i32;
    (origin.x + units(x), origin.y + units(y))
}

/// A scene of cells.
struct Grid {
    width: usize,
    height: usize,
    /// What each cell is, row by row; `None` where nothing is.
    kinds: Vec<Option<AreaKind>>,
}

impl Grid {
    /// The cells of a scene, if they are few enough to be seen.
    fn of(scene: &Scene) -> Option<Grid> {
        let [width, height] = scene.size;
        if !(width >= 1.0 && height >= 1.0 && width * height <= MOST_CELLS) {
            return None;
        }
        let (width, height) = (width as usize, height as usize);
        let mut kinds = vec![None; width * height];
        for Place { kind, min, max } in &scene.areas {
            let (rows, columns) =
                (min[1] as usize..max[1] as usize, min[0] as usize..max[0] as usize);
            for y in rows {
                for x in columns.clone().filter(|x| *x < width && y < height) {
                    kinds[y * width + x] = Some(*kind);
                }
            }
        }
        Some(Grid { width, height, kinds })
    }

    fn cells(&self) -> usize {
        self.kinds.len()
    }

    /// The corner of a cell.
    fn corner(&self, cell: usize) -> (f64, f64) {
        ((cell % self.width) as f64, (cell / self.width) as f64)
    }
}

fn title(canvas: &Area, origin: Origin, words: &str, colour: RGBColor) -> Drawn {
    let style = text(TEXT, colour, HPos::Left, VPos::Bottom);
    canvas.draw(&Text::new(words.to_owned(), (origin.x, origin.y - 10), style))
}

/// Lava, goal, walls and the lines between cells, over whatever the cells show.
fn cells(canvas: &Area, grid: &Grid, origin: Origin) -> Drawn {
    for (cell, kind) in grid.kinds.iter().enumerate() {
        let (x, y) = grid.corner(cell);
        let corners = [at(origin, x, y), at(origin, x + 1.0, y + 1.0)];
        if let Some(kind) = kind {
            canvas.draw(&Rectangle::new(corners, fill(*kind).filled()))?;
        }
        if matches!(kind, Some(AreaKind::Goal | AreaKind::LesserGoal)) {
            let (letter, fill) =
                if *kind == Some(AreaKind::Goal) { ("G", GOAL) } else { ("g", LESSER_GOAL) };
            let style = text(TEXT, on(fill), HPos::Center, VPos::Center);
            canvas.draw(&Text::new(letter, at(origin, x + 0.5, y + 0.5), style))?;
        }
        canvas.draw(&frame(corners, FAINT.stroke_width(1)))?;
    }
    let corners = [at(origin, 0.0, 0.0), at(origin, grid.width as f64, grid.height as f64)];
    canvas.draw(&frame(corners, INK.stroke_width(3)))
}

fn fill(kind: AreaKind) -> RGBColor {
    match kind {
        AreaKind::Lava => LAVA,
        AreaKind::Goal => GOAL,
        AreaKind::LesserGoal => LESSER_GOAL,
        AreaKind::Wall => INK,
    }
}

/// Values of cells as colours with their numbers; `None` stays empty.
fn heat_map(
    canvas: &Area,
    grid: &Grid,
    origin: Origin,
    values: &[Option<f64>],
    greatest: f64,
) -> Drawn {
    for (cell, value) in values.iter().enumerate() {
        // Episodes end in lava and goal: nothing happens there.
        let ends = matches!(
            grid.kinds.get(cell),
            Some(Some(AreaKind::Lava | AreaKind::Goal | AreaKind::LesserGoal)) | None
        );
        let Some(value) = value.filter(|_| !ends) else { continue };
        let (x, y) = grid.corner(cell);
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

pub(super) fn map(scene: &Scene) -> Option<(Picture, String)> {
    let grid = Grid::of(scene)?;
    let layout = Layout { columns: 1, rows: 1, extent: scene.size.into(), unit: UNIT, strip: 0 };
    let picture = figure(layout.size(), |canvas| {
        let origin = layout.origin(0, 0);
        cells(canvas, &grid, origin)?;
        let style = text(TEXT, INK, HPos::Center, VPos::Center);
        let [x, y] = scene.start;
        canvas.draw(&Text::new("S", at(origin, x + 0.5, y + 0.5), style))?;
        title(canvas, origin, "S start, G goal, orange lava", INK)
    })?;
    Some((picture, scene.rules.clone()))
}

/// The scene, where an episode went and where it is now: its last position. `None` if the scene is too large.
pub fn moment(scene: &Scene, trail: &[[f64; 2]]) -> Option<Picture> {
    let grid = Grid::of(scene);
    if grid.is_none() && !is_drawable(scene) {
        return None;
    }
    // A cell's position is its corner.
    let middle = if scene.cells { 0.5 } else { 0.0 };
    let unit = UNIT.min(LARGEST / scene.size[0].max(scene.size[1]));
    let origin = Origin { x: 2, y: 2, unit };
    let (width, height) = at(origin, scene.size[0], scene.size[1]);
    figure((width as u32 + 2, height as u32 + 2), |canvas| {
        match &grid {
            Some(grid) => cells(canvas, grid, origin)?,
            None => arena(canvas, scene, origin)?,
        }
        let line: Vec<(i32, i32)> =
            trail.iter().map(|[x, y]| at(origin, x + middle, y + middle)).collect();
        let now = line.last().copied();
        canvas.draw(&PathElement::new(line, colour(0).mix(0.5).stroke_width(3)))?;
        match now {
            Some(now) => canvas.draw(&Circle::new(now, 9, colour(0).filled())),
            None => Ok(()),
        }
    })
}

/// A picture of a place in the plane.
pub(super) struct Stage(Origin);

impl Stage {
    /// A place in the units of the canvas.
    pub(super) fn at(&self, x: f64, y: f64) -> (i32, i32) {
        at(self.0, x, y)
    }
}

/// The scene side by side under each title, and where. `None` if it is too large.
pub(super) fn stage(scene: &Scene, titles: &[String]) -> Option<(Picture, Vec<Stage>)> {
    if !is_drawable(scene) {
        return None;
    }
    let places: Vec<(usize, usize)> = (0..titles.len()).map(|column| (column, 0)).collect();
    let layout = Layout { strip: 0, ..layout(scene, &places, 1) };
    let origins: Vec<Origin> =
        places.iter().map(|(column, row)| layout.origin(*column, *row)).collect();
    let picture = figure(layout.size(), |canvas| {
        for (origin, words) in origins.iter().zip(titles) {
            title(canvas, *origin, words, INK)?;
            arena(canvas, scene, *origin)?;
        }
        Ok(())
    })?;
    Some((picture, origins.into_iter().map(Stage).collect()))
}

/// The data of a panel's seeds that are of cells.
fn of_cells<'a>(panel: &'a Panel) -> impl Iterator<Item = &'a CellData> {
    panel.seeds.iter().filter_map(|(_, records)| match &records.figure_data.as_ref()?.world {
        WorldData::Cells(cells) => Some(cells),
        WorldData::Plane(_) => None,
    })
}

/// The data of a panel's seeds that are of the plane.
fn of_plane<'a>(panel: &'a Panel) -> impl Iterator<Item = &'a PlaneData> {
    panel.seeds.iter().filter_map(|(_, records)| match &records.figure_data.as_ref()?.world {
        WorldData::Plane(plane) => Some(plane),
        WorldData::Cells(_) => None,
    })
}

pub(super) fn occupancy(scene: &Scene, panels: &[(usize, &Panel)]) -> Option<(Picture, String)> {
    let grid = Grid::of(scene)?;
    let mean = |panel: &Panel| -> Option<Vec<Option<f64>>> {
        let count = of_cells(panel).count() as f64;
        let sum =
            |cell: usize| of_cells(panel).filter_map(|of| of.occupancy.get(cell)).sum::<f64>();
        let seen = |cell| Some(sum(cell) / count).filter(|visits| *visits >= 0.005);
        (count > 0.0).then(|| (0..grid.cells()).map(seen).collect())
    };
    let maps: Vec<(&Panel, Vec<Option<f64>>)> =
        panels.iter().filter_map(|(_, panel)| Some((*panel, mean(panel)?))).collect();
    if maps.is_empty() {
        return None;
    }
    let greatest = 1.0;
    let places = places(maps.iter().map(|(panel, _)| *panel));
    let layout = layout(scene, &places, 1);
    let picture = figure(layout.size(), |canvas| {
        for ((column, row), (panel, values)) in places.iter().zip(&maps) {
            let origin = layout.origin(*column, *row);
            title(canvas, origin, &panel.group.title(), INK)?;
            heat_map(canvas, &grid, origin, values, greatest)?;
        }
        strip(canvas, &layout, "visits per episode", ["0".to_owned(), "1 and more".to_owned()])
    })?;
    let caption = "As in the paper's Figure 3: expected visits of the greedy protagonist in an episode in which \
                   every chosen move is executed (in any episode, where no outcome of chance does that), averaged over \
                   seeds; exact. Empty cells: below 0.005.";
    Some((picture, caption.to_owned()))
}

fn strip(canvas: &Area, layout: &Layout, title: &str, ends: [String; 2]) -> Drawn {
    let top = layout.size().1 as i32 - STRIP;
    scale(&canvas.margin(top, 0, 0, 0), title, ends)
}

pub(super) fn deviations(scene: &Scene, panels: &[(usize, &Panel)]) -> Option<(Picture, String)> {
    let grid = Grid::of(scene)?;
    let pooled = |panel: &Panel, of: fn(&CellData) -> Option<&Deviations>| {
        let seeds: Vec<&Deviations> = of_cells(panel).filter_map(of).collect();
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
        .filter_map(|(_, panel)| {
            let learned = pooled(panel, |of| of.learned.as_ref())?;
            Some((*panel, [learned, pooled(panel, |of| of.exact.as_ref())?]))
        })
        .collect();
    let all = || maps.iter().flat_map(|(_, maps)| maps.iter().flatten().flatten());
    let greatest = all().copied().fold(0.0, f64::max);
    if maps.is_empty() {
        return None;
    }
    let places = places(maps.iter().map(|(panel, _)| *panel));
    let layout = layout(scene, &places, 2);
    let picture = figure(layout.size(), |canvas| {
        for ((column, block), (panel, maps)) in places.iter().zip(&maps) {
            for (row, (name, values)) in
                ["learned", "exact worst case"].iter().zip(maps).enumerate()
            {
                let origin = layout.origin(*column, 2 * block + row);
                title(canvas, origin, &format!("{}, {name}", panel.group.title()), INK)?;
                heat_map(canvas, &grid, origin, values, greatest)?;
            }
        }
        strip(canvas, &layout, "P(deviation)", ["0".to_owned(), format!("{greatest:.2}")])
    })?;
    let data = |(panel, _): &(&Panel, _)| {
        panel.seeds.iter().find_map(|(_, records)| Some(records.figure_data.as_ref()?.episodes))
    };
    let episodes = maps.iter().find_map(data).unwrap_or_default();
    let largest: Vec<String> = (maps.iter())
        .filter_map(|(panel, maps)| {
            Some(format!("{}: {}", panel.group.title(), apart(&grid, maps)?))
        })
        .collect();
    let caption = format!(
        "As in the paper's Figure 4: probability that the executed move is not the chosen one, greedy \
         protagonist. Above against its learned antagonist, counted over {episodes} trajectories per seed; \
         below against the exact worst case, computed for the same policies. Seeds pooled; cells with at \
         least {LEAST_VISITS} visits. Largest differences, learned and exact: {}. Without an antagonist: {}",
        largest.join("; "),
        scene.rules
    );
    Some((picture, caption))
}

/// The three cells in which two maps differ most, with both values; `None` if no cell is in both.
fn apart(grid: &Grid, [learned, exact]: &[Vec<Option<f64>>; 2]) -> Option<String> {
    let both = |cell: usize| Some((cell, learned[cell]?, exact[cell]?));
    let mut cells: Vec<(usize, f64, f64)> = (0..grid.cells()).filter_map(both).collect();
    cells.sort_by(|a, b| (b.1 - b.2).abs().total_cmp(&(a.1 - a.2).abs()).then(a.0.cmp(&b.0)));
    let named = cells.iter().take(3).map(|(cell, learned, exact)| {
        let (x, y) = grid.corner(*cell);
        format!("({x}, {y}) {learned:.2} and {exact:.2}")
    });
    let named: Vec<String> = named.collect();
    (!named.is_empty()).then(|| named.join(", "))
}

/// Lava, goal, walls, start and border of a place in the plane.
fn arena(canvas: &Area, scene: &Scene, origin: Origin) -> Drawn {
    for Place { kind, min, max } in &scene.areas {
        let corners = [at(origin, min[0], min[1]), at(origin, max[0], max[1])];
        canvas.draw(&Rectangle::new(corners, fill(*kind).filled()))?;
    }
    let start = at(origin, scene.start[0], scene.start[1]);
    canvas.draw(&Circle::new(start, 7, INK.stroke_width(3)))?;
    let corners = [at(origin, 0.0, 0.0), at(origin, scene.size[0], scene.size[1])];
    canvas.draw(&frame(corners, INK.stroke_width(3)))
}

/// Whether a place in the plane is of a size that can be drawn.
fn is_drawable(scene: &Scene) -> bool {
    scene.size.iter().all(|side| *side > 0.0 && *side <= LONGEST_SIDE)
}

pub(super) fn trajectories(scene: &Scene, panels: &[(usize, &Panel)]) -> Option<(Picture, String)> {
    let shown: Vec<(usize, &Panel)> =
        panels.iter().copied().filter(|(_, panel)| of_plane(panel).count() > 0).collect();
    if shown.is_empty() || !is_drawable(scene) {
        return None;
    }
    let places = places(shown.iter().map(|(_, panel)| *panel));
    let layout = layout(scene, &places, 1);
    let picture = figure(layout.size(), |canvas| {
        for ((column, row), (place, panel)) in places.iter().zip(&shown) {
            let origin = layout.origin(*column, *row);
            title(canvas, origin, &panel.group.title(), INK)?;
            arena(canvas, scene, origin)?;
            for path in of_plane(panel).flat_map(|of| &of.trajectories) {
                let line: Vec<(i32, i32)> = path.iter().map(|[x, y]| at(origin, *x, *y)).collect();
                canvas.draw(&PathElement::new(line, colour(*place).mix(0.5).stroke_width(2)))?;
            }
        }
        let note = "orange lava, green goal, circle start; lengths in metres";
        let style = text(TEXT, INK, HPos::Left, VPos::Center);
        let y = layout.size().1 as i32 - STRIP / 2;
        canvas.draw(&Text::new(note, (MARGIN.0, y), style))
    })?;
    let each = shown.iter().flat_map(|(_, panel)| of_plane(panel)).map(|of| of.trajectories.len());
    let caption = format!(
        "Greedy protagonists of all seeds under nominal chance, the first {} episodes of each; all meet the \
         same noise. {}",
        each.max().unwrap_or_default(),
        scene.rules
    );
    Some((picture, caption))
}

/// The seeds' maps of one class as one, weighted by their steps.
fn pooled(panel: &Panel, class: usize) -> Option<ShiftMap> {
    let seeds: Vec<&ShiftMap> = of_plane(panel).filter_map(|of| of.shifts.get(class)).collect();
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

pub(super) fn shifts(scene: &Scene, panels: &[(usize, &Panel)]) -> Option<(Picture, String)> {
    if !is_drawable(scene) {
        return None;
    }
    let maps: Vec<(&Panel, Vec<ShiftMap>)> = (panels.iter())
        .filter_map(|(_, panel)| {
            let classes: Option<Vec<ShiftMap>> =
                (0..BUDGET_CLASSES).map(|class| pooled(panel, class)).collect();
            Some((*panel, classes?))
        })
        .collect();
    let PlaneData { bins, bin, .. } = of_plane(maps.first()?.0).next()?;
    // 98 % of the bins stay below it; a few rare ones would take all the colours.
    let mut divergences: Vec<f64> = (maps.iter().flat_map(|(_, maps)| maps))
        .flat_map(|map| map.divergence.iter().zip(&map.visits))
        .filter(|(_, visits)| **visits >= LEAST_STEPS)
        .map(|(divergence, _)| *divergence)
        .collect();
    divergences.sort_by(f64::total_cmp);
    let greatest = *divergences.get(divergences.len().saturating_sub(1) * 98 / 100)?;
    let places = places(maps.iter().map(|(panel, _)| *panel));
    let layout = layout(scene, &places, BUDGET_CLASSES);
    let picture = figure(layout.size(), |canvas| {
        for ((column, block), (panel, classes)) in places.iter().zip(&maps) {
            for (class, map) in classes.iter().enumerate() {
                // The largest remaining budget on top: an episode begins with it.
                let row = BUDGET_CLASSES - 1 - class;
                let origin = layout.origin(*column, block * BUDGET_CLASSES + row);
                let share = |class: usize| short(class as f64 / BUDGET_CLASSES as f64);
                let range = if row == 0 {
                    format!("budget left: {} and more", share(class))
                } else {
                    format!("budget left: {} to {}", share(class), share(class + 1))
                };
                title(canvas, origin, &format!("{}, {range}", panel.group.title()), INK)?;
                shift_map(canvas, origin, (*bins, *bin), map, greatest)?;
                arena(canvas, scene, origin)?;
            }
        }
        let ends = ["0".to_owned(), format!("{greatest:.2} nats")];
        strip(canvas, &layout, "KL to nominal", ends)
    })?;
    let caption = format!(
        "How the learned antagonist shifts the noise against the greedy protagonist, averaged over the steps \
         that began in a square of {bin} m (at least {LEAST_STEPS}), seeds pooled, by remaining budget log \
         eta_t / log eta. Arrow: mean of the noise xi, nominally 0; an arrow as long as a square is 1 \
         standard deviation. Colour: divergence of the shifted law from the nominal one, the mean of log \
         delta_t(o_t)."
    );
    Some((picture, caption))
}

fn shift_map(
    canvas: &Area,
    origin: Origin,
    ([width, height], side): ([usize; 2], f64),
    map: &ShiftMap,
    greatest: f64,
) -> Drawn {
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
    origin: Origin,
    (x, y): (f64, f64),
    (dx, dy): (f64, f64),
    colour: RGBColor,
) -> Drawn {
    let tip = (x + dx, y + dy);
    let line = vec![at(origin, x, y), at(origin, tip.0, tip.1)];
    canvas.draw(&PathElement::new(line, colour.stroke_width(2)))?;
    let length = dx.hypot(dy);
    if length * origin.unit < 6.0 {
        return Ok(());
    }
    let head = 0.14 * (UNIT / origin.unit);
    let (ux, uy) = (dx / length * head, dy / length * head);
    let barb = |sign: f64| at(origin, tip.0 - ux + sign * uy * 0.6, tip.1 - uy - sign * ux * 0.6);
    let head = vec![barb(1.0), at(origin, tip.0, tip.1), barb(-1.0)];
    canvas.draw(&Polygon::new(head, colour.filled()))
}
