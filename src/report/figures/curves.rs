//! Curves and the cross matrix.

use super::Panel;
use super::canvas::{
    Axes, INK, Legend, Picture, TEXT, chart, colour, drawable, figure, frame, heat, on, scale,
    short, span, text, words_width,
};
use crate::experiment::figure_data::{BudgetByTime, FigureData, WorldData};
use crate::game::returns::ReturnLaw;
use crate::report::group::{ALPHAS, Measures};
use crate::report::records::{Records, Update};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};
use std::collections::BTreeSet;

/// Points of a learning curve: a rollout by itself is too noisy to be read.
const BINS: usize = 60;

/// Budgets at which the curve of optima is evaluated, equally spaced in log eta.
const OPTIMA: u32 = 60;

/// Middle of a band and its ends.
#[derive(Debug, Clone, Copy)]
struct Band {
    x: f64,
    low: f64,
    middle: f64,
    high: f64,
}

/// Mean, least and greatest of what the seeds have at each x.
fn over_seeds(seeds: &[Vec<(f64, f64)>]) -> Vec<Band> {
    let longest = seeds.iter().map(Vec::len).max().unwrap_or_default();
    (0..longest)
        .filter_map(|place| {
            let here: Vec<(f64, f64)> = (seeds.iter())
                .filter_map(|seed| seed.get(place).copied())
                .filter(|(x, y)| drawable(*x) && drawable(*y))
                .collect();
            let values = || here.iter().map(|(_, y)| *y);
            (!here.is_empty()).then(|| Band {
                x: here[0].0,
                low: values().fold(f64::INFINITY, f64::min),
                middle: values().sum::<f64>() / here.len() as f64,
                high: values().fold(f64::NEG_INFINITY, f64::max),
            })
        })
        .collect()
}

/// The points of each seed of a panel.
fn of_seeds(panel: &Panel, points: impl Fn(&Records) -> Vec<(f64, f64)>) -> Vec<Vec<(f64, f64)>> {
    panel.seeds.iter().map(|(_, records)| points(records)).collect()
}

/// What the seeds of a row have.
#[derive(Debug, Clone)]
pub struct Line {
    /// What it is called.
    pub title: String,
    /// Points of each seed, which have the same x.
    pub seeds: Vec<Vec<(f64, f64)>>,
}

/// Lines in one chart, each the mean of its seeds in a band of the lowest and the highest one, and a dashed one.
/// `None` if there is nothing to be drawn.
pub fn lines(lines: &[Line], dashed: &[(f64, f64)], titles: (&str, &str)) -> Option<Picture> {
    one_chart(lines, &[], titles, dashed)
}

/// The same with a dashed line of each line's colour.
pub(super) fn named_lines(
    lines: &[Line],
    dashed: &[Vec<(f64, f64)>],
    titles: (&str, &str),
) -> Option<Picture> {
    one_chart(lines, dashed, titles, &[])
}

fn one_chart(
    lines: &[Line],
    dashed: &[Vec<(f64, f64)>],
    titles: (&str, &str),
    limit: &[(f64, f64)],
) -> Option<Picture> {
    let mut facet = Facet { title: String::new(), curves: Vec::new() };
    let mut words = Vec::new();
    for (place, line) in lines.iter().enumerate() {
        let (colour, band) = (colour(place), over_seeds(&line.seeds));
        if !band.is_empty() {
            words.push((line.title.clone(), colour));
        }
        let dashed = dashed.get(place).cloned().unwrap_or_default();
        facet.curves.push(Curve { colour, band, dashed });
    }
    charts(words, &[facet], titles, limit)
}

/// Rows with something to be drawn. Several methods have a chart for each budget, and a method one colour in all charts.
struct ByBudget {
    methods: Vec<String>,
    etas: Vec<f64>,
    words: Vec<(String, RGBColor)>,
}

impl ByBudget {
    /// `has` says which panels are drawn.
    fn new(panels: &[Panel], has: impl Fn(usize) -> bool) -> ByBudget {
        let mut methods: Vec<String> = panels.iter().map(ByBudget::method).collect();
        let mut known = BTreeSet::new();
        methods.retain(|method| known.insert(method.clone()));
        let mut rows = ByBudget { methods, etas: Vec::new(), words: Vec::new() };
        for (place, panel) in panels.iter().enumerate().filter(|(place, _)| has(*place)) {
            let title = if rows.several() { ByBudget::method(panel) } else { panel.group.title() };
            let word = (title, rows.colour(place, panel));
            if !rows.words.contains(&word) {
                rows.words.push(word);
            }
            rows.etas.push(panel.group.eta);
        }
        rows.etas.sort_by(f64::total_cmp);
        rows.etas.dedup();
        rows
    }

    fn method(panel: &Panel) -> String {
        panel.group.method.clone().unwrap_or_default()
    }

    fn several(&self) -> bool {
        self.methods.len() > 1
    }

    /// The colour of the panel in this place.
    fn colour(&self, place: usize, panel: &Panel) -> RGBColor {
        let method = self.methods.iter().position(|of| *of == ByBudget::method(panel));
        colour(method.filter(|_| self.several()).unwrap_or(place))
    }

    fn title(eta: f64) -> String {
        format!("eta = {eta}")
    }
}

/// A row's line in its band, and a dashed one of the same colour.
struct Curve {
    colour: RGBColor,
    band: Vec<Band>,
    dashed: Vec<(f64, f64)>,
}

/// A chart of curves beside others on the same axes.
struct Facet {
    title: String,
    curves: Vec<Curve>,
}

/// With more curves than this a chart leaves their bands out, which would hide each other.
const MOST_BANDS: usize = 5;

const LINES_AND_BANDS: &str =
    "Line: mean over seeds; band, in charts of at most five lines: lowest and highest seed.";

/// A curve for each row: in one chart those of one method, in a chart for each budget those of several.
fn of_rows(
    panels: &[Panel],
    bands: Vec<Vec<Band>>,
    titles: (&str, &str),
    dashed: Vec<Vec<(f64, f64)>>,
) -> Option<Picture> {
    let rows = ByBudget::new(panels, |place| !bands[place].is_empty());
    let mut facets: Vec<Facet> = if rows.several() {
        let facet = |&eta: &f64| Facet { title: ByBudget::title(eta), curves: Vec::new() };
        rows.etas.iter().map(facet).collect()
    } else {
        vec![Facet { title: String::new(), curves: Vec::new() }]
    };
    let dashed = dashed.into_iter().chain(std::iter::repeat_with(Vec::new));
    for (place, ((panel, band), dashed)) in panels.iter().zip(bands).zip(dashed).enumerate() {
        if band.is_empty() {
            continue;
        }
        let facet = rows.etas.iter().position(|eta| rows.several() && *eta == panel.group.eta);
        let colour = rows.colour(place, panel);
        facets[facet.unwrap_or_default()].curves.push(Curve { colour, band, dashed });
    }
    charts(rows.words, &facets, titles, &[])
}

/// Charts side by side. `limit` is a dashed line of no row.
fn charts(
    mut words: Vec<(String, RGBColor)>,
    facets: &[Facet],
    (x_title, y_title): (&str, &str),
    limit: &[(f64, f64)],
) -> Option<Picture> {
    let curves = || facets.iter().flat_map(|facet| &facet.curves);
    if curves().all(|curve| curve.band.is_empty()) {
        return None;
    }
    let banded = |facet: &Facet| facet.curves.len() <= MOST_BANDS;
    let all = || curves().flat_map(|curve| &curve.band);
    let others = || curves().flat_map(|curve| &curve.dashed).chain(limit);
    let x = span(all().map(|band| band.x).chain(others().map(|(x, _)| *x)))?;
    let reach = |facet: &Facet| -> Vec<f64> {
        let bands = facet.curves.iter().flat_map(|curve| &curve.band);
        let ends = |band: &Band| {
            if banded(facet) { [band.low, band.high] } else { [band.middle; 2] }
        };
        bands.flat_map(ends).collect()
    };
    let y = span(facets.iter().flat_map(reach).chain(others().map(|(_, y)| *y)))?;
    if !limit.is_empty() {
        words.push(("optimum".to_owned(), INK));
    }
    let (width, height) = if facets.len() > 1 { (690, 674) } else { (1380, 714) };
    let width = width * facets.len() as u32;
    let legend = Legend::new(words, width);
    figure((width, legend.height + height), |canvas| {
        let (top, below) = canvas.split_vertically(legend.height);
        legend.draw(&top)?;
        for (area, facet) in below.split_evenly((1, facets.len())).iter().zip(facets) {
            let axes = Axes { x: x.clone(), y: y.clone(), x_title, y_title };
            let mut chart = chart(area, &facet.title, axes)?;
            for Curve { colour, band, .. } in facet.curves.iter().filter(|_| banded(facet)) {
                let outline = band.iter().map(|band| (band.x, band.high));
                let back = band.iter().rev().map(|band| (band.x, band.low));
                let area: Vec<(f64, f64)> = outline.chain(back).collect();
                chart.draw_series(std::iter::once(Polygon::new(area, colour.mix(0.18))))?;
            }
            for Curve { colour, band, .. } in &facet.curves {
                let line = band.iter().map(|band| (band.x, band.middle));
                chart.draw_series(LineSeries::new(line, colour.stroke_width(4)))?;
            }
            for Curve { colour, dashed, .. } in &facet.curves {
                let style = colour.stroke_width(4);
                chart.draw_series(DashedLineSeries::new(dashed.iter().copied(), 10, 8, style))?;
            }
            let (line, style) = (limit.iter().copied(), INK.stroke_width(4));
            chart.draw_series(DashedLineSeries::new(line, 10, 8, style))?;
        }
        Ok(())
    })
}

pub(super) fn learning(panels: &[Panel]) -> Option<(Picture, String)> {
    let points = |records: &Records| {
        let updates = &records.progress;
        let width = updates.len().div_ceil(BINS).max(1);
        let bin = |bin: &[Update]| {
            let returns: Vec<f64> =
                bin.iter().map(|of| of.mean_return).filter(|of| of.is_finite()).collect();
            let mean = returns.iter().sum::<f64>() / returns.len() as f64;
            (bin[bin.len() - 1].steps, mean)
        };
        updates.chunks(width).map(bin).collect()
    };
    let found: Vec<Vec<Band>> =
        panels.iter().map(|panel| over_seeds(&of_seeds(panel, points))).collect();
    let svg = of_rows(panels, found, ("environment steps", "return in training"), Vec::new())?;
    let caption = "Mean undiscounted return of the episodes that ended in a rollout, the sampled protagonist \
                   against its antagonist: so at eta above 1 it is not the nominal return, and it falls \
                   as the budget rises.";
    Some((svg, format!("{caption} {LINES_AND_BANDS}")))
}

pub(super) fn regret(panels: &[Panel]) -> Option<(Picture, String)> {
    let point = |update: &Update| Some((update.steps, update.regret?));
    let points = |records: &Records| records.progress.iter().filter_map(point).collect();
    let band = |of: Band| Band {
        x: of.x,
        low: place(of.low),
        middle: place(of.middle),
        high: place(of.high),
    };
    let found: Vec<Vec<Band>> = (panels.iter())
        .map(|panel| over_seeds(&of_seeds(panel, points)).into_iter().map(band).collect())
        .collect();
    let svg = of_rows(panels, found, ("environment steps", "log10 of regret"), Vec::new())?;
    let caption = "The best CVaR_1/eta that is known minus that of the greedy protagonist as it is after so many \
                   steps (at eta = 1 the best mean minus its mean): exact in finite worlds, else of a few thousand \
                   episodes.";
    Some((
        svg,
        format!("{caption} Regrets below {LEAST_REGRET} are drawn there. {LINES_AND_BANDS}"),
    ))
}

/// Regrets of at most this are drawn as this.
pub(super) const LEAST_REGRET: f64 = 1e-3;

/// Where a regret is drawn.
fn place(regret: f64) -> f64 {
    regret.max(LEAST_REGRET).log10()
}

/// The performance profile: the share of runs whose regret is at most so much (Agarwal and others, NeurIPS 2021). A run
/// without a result never is among them.
pub(super) fn profile(panels: &[Panel]) -> Option<(Picture, String)> {
    let found: Vec<Vec<f64>> = (panels.iter())
        .map(|panel| {
            let regrets = panel.group.measures.iter().filter_map(|of| of.regret);
            let mut places: Vec<f64> = regrets.map(place).collect();
            places.sort_by(f64::total_cmp);
            places
        })
        .collect();
    let rows = ByBudget::new(panels, |place| !found[place].is_empty());
    let x = span(found.iter().flatten().copied().chain([LEAST_REGRET.log10()]))?;
    let width = 690 * rows.etas.len().max(1) as u32;
    let legend = Legend::new(if rows.several() { rows.words.clone() } else { Vec::new() }, width);
    let svg = figure((width, legend.height + 674), |canvas| {
        let (top, below) = canvas.split_vertically(legend.height);
        legend.draw(&top)?;
        for (area, &eta) in below.split_evenly((1, rows.etas.len())).iter().zip(&rows.etas) {
            let (x_title, y_title) = ("log10 of regret", "share of runs");
            let axes = Axes { x: x.clone(), y: 0.0..1.02, x_title, y_title };
            let mut chart = chart(area, &ByBudget::title(eta), axes)?;
            for (place, (panel, places)) in panels.iter().zip(&found).enumerate() {
                if panel.group.eta != eta || places.is_empty() {
                    continue;
                }
                let runs = panel.group.measures.len() as f64;
                let step =
                    |(i, &at): (usize, &f64)| [(at, i as f64 / runs), (at, (i + 1) as f64 / runs)];
                let steps = places.iter().enumerate().flat_map(step);
                let ends = [(x.start, 0.0), (x.end, places.len() as f64 / runs)];
                let line = ends[..1].iter().copied().chain(steps).chain(ends[1..].iter().copied());
                chart.draw_series(LineSeries::new(
                    line,
                    rows.colour(place, panel).stroke_width(4),
                ))?;
            }
        }
        Ok(())
    })?;
    let caption = format!(
        "The share of runs whose regret at 1/eta is at most that of the axis (a performance profile): further up and to \
         the left is better. Regrets below {LEAST_REGRET} are drawn there; a run without a result is in none."
    );
    Some((svg, caption))
}

/// Probability of improvement (Agarwal and others, NeurIPS 2021): how often a run of the first method has a better
/// CVaR_1/eta than one of each other method.
pub(super) fn improvement(panels: &[Panel]) -> Option<(Picture, String)> {
    let against = |panel: &Panel| {
        let alike = |of: &&Panel| of.group.eta == panel.group.eta && of.task() == panel.task();
        let first = panels.iter().find(alike)?;
        let (own, other) = (first.group.method.as_ref()?, panel.group.method.as_ref()?);
        let of = first.group.improvement(panel.group).filter(|_| own != other)?;
        Some((format!("{own}  >  {other}, eta = {}", panel.group.eta), of))
    };
    let rows: Vec<_> = panels.iter().filter_map(against).collect();
    let widest = rows.iter().map(|(title, _)| words_width(title)).max()?;
    let (left, width, height, top) = (widest + 60, 700, 52, 40);
    let bottom = top + height * rows.len() as i32;
    let at = |share: f64| left + (share * f64::from(width)).round() as i32;
    let size = ((left + width + 60) as u32, (bottom + 120) as u32);
    let svg = figure(size, |canvas| {
        let words = |side| text(TEXT, INK, side, VPos::Center);
        for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
            let line = vec![(at(share), top), (at(share), bottom)];
            let style = INK.mix(if share == 0.5 { 1.0 } else { 0.2 }).stroke_width(2);
            canvas.draw(&PathElement::new(line, style))?;
            let place = (at(share), bottom + 28);
            canvas.draw(&Text::new(short(share), place, words(HPos::Center)))?;
        }
        let place = (at(0.5), bottom + 76);
        canvas.draw(&Text::new("probability", place, words(HPos::Center)))?;
        for (row, (title, of)) in rows.iter().enumerate() {
            let y = top + height * row as i32 + height / 2;
            canvas.draw(&Text::new(title.clone(), (left - 24, y), words(HPos::Right)))?;
            if let Some(interval) = of.interval {
                let band = [(at(interval.low), y - 14), (at(interval.high), y + 14)];
                canvas.draw(&Rectangle::new(band, colour(0).mix(0.35).filled()))?;
            }
            let mark = [(at(of.value) - 3, y - 18), (at(of.value) + 3, y + 18)];
            canvas.draw(&Rectangle::new(mark, colour(0).filled()))?;
        }
        Ok(())
    })?;
    let caption = "The probability that a run of the first method has a higher CVaR_1/eta than a run of the other \
                   one (at eta = 1, a higher mean), ties counting half: 0.5 is no difference. Band: Newcombe's 95 % \
                   interval.";
    Some((svg, caption.to_owned()))
}

pub(super) fn budget(panels: &[Panel]) -> Option<(Picture, String)> {
    let by_time = |every: u32, values: &[f64]| {
        (0..)
            .map(|place: u32| f64::from(place) * f64::from(every))
            .zip(values.iter().copied())
            .collect()
    };
    let mut found = Vec::new();
    let mut exact = Vec::new();
    for panel in panels {
        let seeds: Vec<&FigureData> =
            panel.seeds.iter().filter_map(|(_, records)| records.figure_data.as_ref()).collect();
        let mean = |of: fn(&BudgetByTime) -> &Vec<f64>| {
            let budgets = seeds.iter().filter_map(|data| data.budget.as_ref());
            over_seeds(&budgets.map(|budget| by_time(budget.every, of(budget))).collect::<Vec<_>>())
        };
        let (low, high) = (mean(|of| &of.low), mean(|of| &of.high));
        found.push(
            (mean(|of| &of.mean).iter().zip(low.iter().zip(&high)))
                .map(|(band, (low, high))| Band { low: low.middle, high: high.middle, ..*band })
                .collect(),
        );
        let budgets = seeds.iter().filter_map(|data| match &data.world {
            WorldData::Cells(cells) => Some(by_time(1, &cells.exact_budget)),
            WorldData::Plane(_) => None,
        });
        let bands = over_seeds(&budgets.collect::<Vec<_>>());
        exact.push(bands.iter().map(|band| (band.x, band.middle)).collect());
    }
    let has_exact = exact.iter().any(|line: &Vec<(f64, f64)>| !line.is_empty());
    let svg = of_rows(panels, found, ("time t (steps)", "log eta_t / log eta"), exact)?;
    let mut caption = "Remaining budget of the episodes that still run at time t, greedy protagonist against \
                       its learned antagonist: 1 is all of it, 0 none. Line: mean over trajectories, then \
                       seeds; band: 10 % and 90 % quantiles."
        .to_owned();
    if has_exact {
        caption += " Dashed: the exact worst-case antagonist, in expectation.";
    }
    Some((svg, caption))
}

/// The budgets from 1 to the greatest at which optima are drawn.
pub(super) fn frontier_budgets(greatest: f64) -> Vec<f64> {
    (0..=OPTIMA).map(|step| greatest.powf(f64::from(step) / f64::from(OPTIMA))).collect()
}

/// `optima` are the laws of the policies that are optimal at [`frontier_budgets`], where the world has an
/// exact yardstick.
pub(super) fn frontier(
    panels: &[Panel],
    optima: Option<&[ReturnLaw]>,
    greatest: f64,
) -> Option<(Picture, String)> {
    let mut levels: Vec<f64> =
        panels.iter().map(|panel| panel.group.alpha()).filter(|a| *a < 1.0).collect();
    levels.sort_by(|a, b| b.total_cmp(a));
    levels.dedup();
    let curve = |&alpha: &f64| {
        let points = optima.into_iter().flatten().map(|law| (law.cvar(alpha), law.mean()));
        points.filter(|(x, y)| drawable(*x) && drawable(*y)).collect()
    };
    let curves: Vec<Vec<(f64, f64)>> = levels.iter().map(curve).collect();
    let rows = ByBudget::new(panels, |_| true);
    let several = rows.several();
    // Of several methods, at each level the rows that were trained for it.
    let shown = |panel: &Panel, alpha| !several || panel.group.alpha() == alpha;
    let dots: Vec<Vec<(RGBColor, f64, f64)>> = (levels.iter())
        .map(|&alpha| {
            let of_panel = |(place, panel): (usize, &Panel)| {
                let level = panel.group.level(alpha);
                let colour = rows.colour(place, panel);
                let point = |measures: &Measures| {
                    let (x, y) = (measures.cvar[level]?, measures.mean?);
                    (drawable(x) && drawable(y)).then_some((colour, x, y))
                };
                panel.group.measures.iter().filter_map(point).collect::<Vec<_>>()
            };
            let panels = panels.iter().enumerate().filter(|(_, panel)| shown(panel, alpha));
            panels.flat_map(of_panel).collect()
        })
        .collect();
    let points = || {
        let dots = dots.iter().flatten().map(|&(_, x, y)| (x, y));
        dots.chain(curves.iter().flatten().copied())
    };
    let (x, y) = (span(points().map(|(x, _)| x))?, span(points().map(|(_, y)| y))?);
    let width = 690 * levels.len().max(1) as u32;
    let mut words = if several {
        rows.words
    } else {
        let named = |(place, panel): (usize, &Panel)| {
            (format!("trained at eta = {}", panel.group.eta), colour(place))
        };
        panels.iter().enumerate().map(named).collect()
    };
    if optima.is_some() {
        words.push(("exact optima".to_owned(), INK));
    }
    let legend = Legend::new(words, width);
    let svg = figure((width, legend.height + 674), |canvas| {
        let (top, below) = canvas.split_vertically(legend.height);
        legend.draw(&top)?;
        for ((area, &alpha), (dots, curve)) in
            below.split_evenly((1, levels.len())).iter().zip(&levels).zip(dots.iter().zip(&curves))
        {
            let title = format!("alpha = {}", short(alpha));
            let axes = Axes { x: x.clone(), y: y.clone(), x_title: "CVaR_alpha", y_title: "mean" };
            let mut chart = chart(area, &title, axes)?;
            chart.draw_series(LineSeries::new(curve.iter().copied(), INK.stroke_width(3)))?;
            chart.draw_series(curve.iter().map(|&point| Circle::new(point, 4, INK.filled())))?;
            chart.draw_series(
                (dots.iter())
                    .map(|&(colour, x, y)| Circle::new((x, y), 10, colour.mix(0.75).filled())),
            )?;
        }
        Ok(())
    })?;
    let mut caption = "A dot is the greedy protagonist of one seed under nominal chance: its mean return \
                       against the mean of its worst alpha-share of returns. Up and to the right is better."
        .to_owned();
    if several {
        caption += " A level has the rows that were trained for it.";
    }
    if optima.is_some() {
        caption += &format!(
            " Black: the policies that are exactly optimal at budgets from 1 to {greatest}, each at \
             both coordinates; no policy lies to the right of the curve's right end."
        );
    }
    Some((svg, caption))
}

pub(super) fn cross(panels: &[Panel]) -> Option<(Picture, String)> {
    let cell = |panel: &Panel, alpha| {
        let level = panel.group.level(alpha);
        panel.group.mean(|measures| measures.cvar[level]).map(|estimate| estimate.value)
    };
    let values: Vec<[Option<f64>; ALPHAS.len()]> =
        panels.iter().map(|panel| ALPHAS.map(|alpha| cell(panel, alpha))).collect();
    let known = || values.iter().flatten().flatten().copied();
    let (low, high) =
        (known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max));
    if low > high {
        return None;
    }
    let titles = panels.iter().filter(|panel| panel.group.method.is_some());
    let widest = titles.map(|panel| words_width(&panel.group.title())).max().unwrap_or_default();
    let (left, width, height, top) = (190.max(widest + 40), 160, 92, 120);
    let size = (left + width * ALPHAS.len() as i32 + 30, top + height * panels.len() as i32 + 90);
    let svg = figure((size.0 as u32, size.1 as u32), |canvas| {
        let centred = |colour| text(TEXT, colour, HPos::Center, VPos::Center);
        canvas.draw(&Text::new(
            "mean of the worst alpha-share of returns, alpha =",
            (left, 36),
            text(TEXT, INK, HPos::Left, VPos::Center),
        ))?;
        for (column, alpha) in ALPHAS.iter().enumerate() {
            let x = left + width * column as i32 + width / 2;
            canvas.draw(&Text::new(short(*alpha), (x, top - 30), centred(INK)))?;
        }
        for (row, (panel, values)) in panels.iter().zip(&values).enumerate() {
            let y = top + height * row as i32;
            canvas.draw(&Text::new(
                panel.group.title(),
                (left - 18, y + height / 2),
                text(TEXT, INK, HPos::Right, VPos::Center),
            ))?;
            for (column, value) in values.iter().enumerate() {
                let Some(value) = value else { continue };
                let x = left + width * column as i32;
                let shade = heat((value - low) / (high - low).max(1e-9));
                let area = [(x, y), (x + width, y + height)];
                canvas.draw(&Rectangle::new(area, shade.filled()))?;
                let middle = (x + width / 2, y + height / 2);
                canvas.draw(&Text::new(format!("{value:.3}"), middle, centred(on(shade))))?;
                // The level that the row was trained for.
                if (ALPHAS[column] * panel.group.eta - 1.0).abs() < 1e-9 {
                    let inner = [(x + 4, y + 4), (x + width - 4, y + height - 4)];
                    canvas.draw(&frame(inner, on(shade).stroke_width(4)))?;
                }
            }
        }
        let strip = canvas.margin(size.1 - 70, 0, 0, 0);
        scale(&strip, "CVaR_alpha", [short(low), short(high)])
    })?;
    let caption = "Rows are the budgets the policies were trained at, columns the levels they are measured \
                   at: mean over seeds of the greedy protagonist's CVaR under nominal chance. Framed: the \
                   level a row was trained for, which should hold the best value of its column.";
    Some((svg, caption.to_owned()))
}
