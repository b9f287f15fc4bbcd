//! How far every row is from the best that is known, and how sure that is.

use super::Panel;
use super::canvas::{INK, LAVA, Picture, TEXT, colour, figure, short, text, words_width};
use super::curves::LEAST_REGRET as LEAST;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

/// Height of a row, and of the words above the rows of a budget.
const ROW: i32 = 46;
const HEADING: i32 = 58;

/// Regret of each row on a logarithmic axis: every seed, the mean with its interval, and how many seeds failed.
pub(super) fn overview(panels: &[Panel]) -> Option<(Picture, String)> {
    let shown: Vec<&Panel> = (panels.iter())
        .filter(|panel| panel.group.measures.iter().any(|of| of.regret.is_some()))
        .collect();
    let mut etas: Vec<f64> = shown.iter().map(|panel| panel.group.eta).collect();
    etas.sort_by(f64::total_cmp);
    etas.dedup();
    let all =
        || shown.iter().flat_map(|panel| panel.group.measures.iter().filter_map(|of| of.regret));
    let place = |regret: f64| regret.max(LEAST).log10();
    let last = all().map(place).fold(LEAST.log10() + 1.0, f64::max).ceil();
    // One method alone needs no heading for each budget.
    let several = shown.iter().any(|panel| panel.group.method.is_some());
    let name = |panel: &Panel| match &panel.group.method {
        Some(method) if several => method.clone(),
        _ => panel.group.title(),
    };
    let failed = |panel: &Panel| match panel.group.failures() {
        0 => String::new(),
        failures => format!("{failures} of {} failed", panel.group.runs.len()),
    };
    let widest = |of: &dyn Fn(&Panel) -> String| {
        shown.iter().map(|panel| words_width(&of(panel))).max().unwrap_or_default()
    };
    let (left, width, right) = (widest(&name) + 60, 620, widest(&failed) + 60);
    let headings = if several { etas.len() as i32 } else { 0 };
    let bottom = 20 + ROW * shown.len() as i32 + HEADING * headings;
    let at = |place: f64| {
        let share = (place - LEAST.log10()) / (last - LEAST.log10());
        left + (share * f64::from(width)).round() as i32
    };
    let picture = figure(((left + width + right) as u32, (bottom + 120) as u32), |canvas| {
        let words = |side| text(TEXT, INK, side, VPos::Center);
        for tick in LEAST.log10() as i32..=last as i32 {
            let x = at(f64::from(tick));
            let line = vec![(x, 20), (x, bottom)];
            canvas.draw(&PathElement::new(line, INK.mix(0.2).stroke_width(2)))?;
            let number = short(10f64.powi(tick));
            let number =
                if f64::from(tick) == LEAST.log10() { format!("≤ {number}") } else { number };
            canvas.draw(&Text::new(number, (x, bottom + 28), words(HPos::Center)))?;
        }
        let middle = (left + width / 2, bottom + 76);
        canvas.draw(&Text::new(
            "regret: 0 is the best that is known",
            middle,
            words(HPos::Center),
        ))?;
        let mut y = 20 - ROW / 2;
        for eta in &etas {
            if several {
                y += HEADING;
                let heading = (left - 24, y);
                let style = text(TEXT + 4, INK, HPos::Right, VPos::Center);
                canvas.draw(&Text::new(format!("eta = {eta}"), heading, style))?;
            }
            for panel in shown.iter().filter(|panel| panel.group.eta == *eta) {
                y += ROW;
                let of_panel = |of: &&&Panel| std::ptr::eq(**of, *panel);
                let own = colour(if several {
                    0
                } else {
                    shown.iter().position(|of| of_panel(&of)).unwrap_or(0)
                });
                canvas.draw(&Text::new(name(panel), (left - 24, y), words(HPos::Right)))?;
                for (run, of) in panel.group.runs.iter().zip(&panel.group.measures) {
                    let Some(regret) = of.regret else { continue };
                    let seed = if run.failed { LAVA } else { own };
                    let dot = (at(place(regret)), y);
                    canvas.draw(&Circle::new(dot, 6, seed.mix(0.45).filled()))?;
                }
                if let Some(mean) = panel.group.mean(|of| of.regret) {
                    if let Some(interval) = mean.interval {
                        let ends =
                            [interval.low, interval.high].map(|end| at(place(end).min(last)));
                        let band = vec![(ends[0], y), (ends[1], y)];
                        canvas.draw(&PathElement::new(band, own.stroke_width(6)))?;
                    }
                    let x = at(place(mean.value));
                    let mark = [(x - 4, y - 16), (x + 4, y + 16)];
                    canvas.draw(&Rectangle::new(mark, own.filled()))?;
                }
                let style = text(TEXT, LAVA, HPos::Left, VPos::Center);
                canvas.draw(&Text::new(failed(panel), (left + width + 24, y), style))?;
            }
        }
        Ok(())
    });
    let caption = format!(
        "Regret: the best CVaR_1/eta that is known, minus that of the greedy protagonist (at eta = 1 of means). Dots are \
         seeds, the bar is the mean of those that did not fail (of all, where all did) with its 95 % interval, on a logarithmic axis; regrets \
         below {LEAST} are drawn there, and ends of intervals too. Orange: failed."
    );
    shown.first().and(picture).map(|picture| (picture, caption))
}
