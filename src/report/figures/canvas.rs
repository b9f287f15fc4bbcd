//! Panels side by side on one canvas, their colours and axes, and the way to PNG.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::sync::{Arc, LazyLock};

pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// Drawing into a text fails only by an error in this crate, and then the figure is left out.
pub(super) type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

/// Lines and words. The page's dark mode knows these three colours by their values.
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
pub(super) const FAINT: RGBColor = RGBColor(0xD8, 0xD8, 0xD8);
pub(super) const LAVA: RGBColor = RGBColor(0xD5, 0x5E, 0x00);
pub(super) const GOAL: RGBColor = RGBColor(0x00, 0x9E, 0x73);
pub(super) const LESSER_GOAL: RGBColor = RGBColor(0x7F, 0xCE, 0xB9);

/// Size of the words in panels, in the canvas's units.
pub(super) const TEXT: u32 = 26;

/// Okabe & Ito's colours but for yellow, which white swallows; those of goal and lava last.
const COLOURS: [RGBColor; 6] = [
    RGBColor(0x00, 0x72, 0xB2),
    RGBColor(0xCC, 0x79, 0xA7),
    RGBColor(0xE6, 0x9F, 0x00),
    RGBColor(0x56, 0xB4, 0xE9),
    GOAL,
    LAVA,
];

/// The colour of the row in this place. After the first six they come again, darker and then lighter.
pub(super) fn colour(place: usize) -> RGBColor {
    let RGBColor(r, g, b) = COLOURS[place % COLOURS.len()];
    let shade = |side: u8| match place / COLOURS.len() % 3 {
        0 => side,
        1 => side / 2,
        _ => side / 2 + 120,
    };
    RGBColor(shade(r), shade(g), shade(b))
}

/// A magnitude in [0, 1] as a colour: viridis, from dark to bright.
pub(super) fn heat(share: f64) -> RGBColor {
    // 0 of 0 counts as 0.
    ViridisRGB::get_color(if share.is_nan() { 0.0 } else { share.clamp(0.0, 1.0) })
}

/// Black or white, whichever can be read on a colour.
pub(super) fn on(RGBColor(r, g, b): RGBColor) -> RGBColor {
    let luminance = 0.299 * f64::from(r) + 0.587 * f64::from(g) + 0.114 * f64::from(b);
    if luminance > 140.0 { BLACK } else { RGBColor(0xFE, 0xFE, 0xFE) }
}

pub(super) fn text(size: u32, colour: RGBColor, h: HPos, v: VPos) -> TextStyle<'static> {
    ("sans-serif", size).into_font().color(&colour).pos(Pos::new(h, v))
}

/// A drawing.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// As SVG.
    pub svg: String,
    /// Its width in pixels.
    pub width: u32,
}

/// A figure of this size, drawn by `draw`.
pub(super) fn figure(size: (u32, u32), draw: impl FnOnce(&Area) -> Drawn) -> Option<Picture> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE).ok()?;
        draw(&area).ok()?;
        area.present().ok()?;
    }
    Some(Picture { svg, width: size.0 })
}

/// Axes of a chart.
pub(super) struct Axes<'a> {
    pub x: std::ops::Range<f64>,
    pub y: std::ops::Range<f64>,
    pub x_title: &'a str,
    pub y_title: &'a str,
}

/// Whether an axis can hold a number: beyond this there is nothing to be seen, and ticks would be
/// counted without end.
pub(super) fn drawable(value: f64) -> bool {
    value.abs() <= 1e12
}

/// Finitely many numbers as a range with some air.
pub(super) fn span(values: impl Iterator<Item = f64>) -> Option<std::ops::Range<f64>> {
    let (low, high) = values
        .filter(|value| drawable(*value))
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    let air = 0.05 * (high - low).max(0.02).max(1e-3 * low.abs().max(high.abs()));
    (low <= high).then_some(low - air..high + air)
}

pub(super) type Chart<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

/// A panel with a title, axes and faint lines.
pub(super) fn chart<'a, 'b>(
    area: &'a Area<'b>,
    title: &str,
    axes: Axes<'_>,
) -> Result<Chart<'a, 'b>, DrawingAreaErrorKind<std::io::Error>> {
    let mut builder = ChartBuilder::on(area);
    if !title.is_empty() {
        builder.caption(title, ("sans-serif", TEXT + 4).into_font().color(&INK));
    }
    let mut chart = builder
        .margin(18)
        .x_label_area_size(74)
        .y_label_area_size(104)
        .build_cartesian_2d(axes.x, axes.y)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .axis_style(INK)
        .x_labels(6)
        .y_labels(7)
        .x_desc(axes.x_title)
        .y_desc(axes.y_title)
        .x_label_formatter(&|x| short(*x))
        .y_label_formatter(&|y| short(*y))
        .label_style(("sans-serif", TEXT).into_font().color(&INK))
        .axis_desc_style(("sans-serif", TEXT).into_font().color(&INK))
        .draw()?;
    Ok(chart)
}

/// A tick: no more digits than it needs.
pub(super) fn short(value: f64) -> String {
    if value.abs() >= 1e5 {
        return format!("{}M", short(value / 1e6));
    }
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

/// Height of a legend of one row.
const LEGEND: u32 = 46;
/// Height of every further row.
const LEGEND_ROW: i32 = 34;

/// Words in their colours above the panels, in as many rows as they need.
pub(super) struct Legend {
    words: Vec<(String, RGBColor, (i32, i32))>,
    /// Height in the canvas's units.
    pub height: u32,
}

impl Legend {
    /// Places the words in a figure of this width.
    pub(super) fn new(words: Vec<(String, RGBColor)>, width: u32) -> Legend {
        let (mut x, mut y) = (30, 24);
        let place = |(word, colour): (String, RGBColor)| {
            let needed = words_width(&word);
            if x > 30 && x + 36 + needed > width as i32 {
                (x, y) = (30, y + LEGEND_ROW);
            }
            let at = (x, y);
            x += 80 + needed;
            (word, colour, at)
        };
        let words = words.into_iter().map(place).collect();
        Legend { words, height: LEGEND + (y - 24) as u32 }
    }

    pub(super) fn draw(&self, area: &Area) -> Drawn {
        for (word, colour, (x, y)) in &self.words {
            area.draw(&Rectangle::new([(*x, y - 6), (x + 26, y + 6)], colour.filled()))?;
            area.draw(&Text::new(
                word.clone(),
                (x + 36, *y),
                text(TEXT, INK, HPos::Left, VPos::Center),
            ))?;
        }
        Ok(())
    }
}

/// About the width of words in panels, in the canvas's units.
pub(super) fn words_width(words: &str) -> i32 {
    (words.chars().count() as f64 * 0.52 * f64::from(TEXT)) as i32
}

/// A scale of [`heat`] with its two ends, in a strip of the canvas.
pub(super) fn scale(area: &Area, title: &str, ends: [String; 2]) -> Drawn {
    let (width, height) = area.dim_in_pixel();
    let (left, right) = (width as i32 / 2 - 40, width as i32 - 190);
    let (top, bottom) = (height as i32 / 2 - 12, height as i32 / 2 + 12);
    for step in 0..64 {
        let at = |step: i32| left + (right - left) * step / 64;
        let colour = heat(f64::from(step) / 63.0);
        area.draw(&Rectangle::new([(at(step), top), (at(step + 1), bottom)], colour.filled()))?;
    }
    let middle = height as i32 / 2;
    let right_of = |h| text(TEXT, INK, h, VPos::Center);
    area.draw(&Text::new(title.to_owned(), (24, middle), right_of(HPos::Left)))?;
    let [low, high] = ends;
    area.draw(&Text::new(low, (left - 12, middle), right_of(HPos::Right)))?;
    area.draw(&Text::new(high, (right + 12, middle), right_of(HPos::Left)))
}

/// A frame of two corners. As a path, because a rectangle's line has no width in SVG.
pub(super) fn frame(
    [(x0, y0), (x1, y1)]: [(i32, i32); 2],
    style: ShapeStyle,
) -> PathElement<(i32, i32)> {
    PathElement::new(vec![(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], style)
}

/// The font of PNGs: a machine may have none.
static FONTS: LazyLock<Arc<resvg::usvg::fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = resvg::usvg::fontdb::Database::new();
    fonts.load_font_data(dejavu::sans::regular().to_vec());
    fonts.set_sans_serif_family("DejaVu Sans");
    Arc::new(fonts)
});

/// The most pixels of a PNG.
const MOST_PIXELS: f64 = 4e7;

/// The SVG as PNG, pixel by unit unless it is too large for that.
///
/// # Errors
/// If it is no SVG.
pub fn png(svg: &str) -> Result<Vec<u8>, String> {
    pixels(svg)?.encode_png().map_err(|error| error.to_string())
}

/// The SVG as red, green and blue of each pixel, shape `[height, width, 3]`, on white.
///
/// # Errors
/// If it is no SVG.
pub fn rgb(svg: &str) -> Result<(Vec<u8>, [usize; 3]), String> {
    let pixels = pixels(svg)?;
    // The picture's ground is white, so that every pixel is opaque.
    let colours = pixels.pixels().iter().flat_map(|of| [of.red(), of.green(), of.blue()]).collect();
    Ok((colours, [pixels.height() as usize, pixels.width() as usize, 3]))
}

fn pixels(svg: &str) -> Result<resvg::tiny_skia::Pixmap, String> {
    let options = resvg::usvg::Options { fontdb: Arc::clone(&FONTS), ..Default::default() };
    let tree = resvg::usvg::Tree::from_str(svg, &options).map_err(|error| error.to_string())?;
    let (width, height) = (tree.size().width(), tree.size().height());
    let scale = (MOST_PIXELS / (f64::from(width) * f64::from(height))).sqrt().min(1.0) as f32;
    let [width, height] = [width, height].map(|side| (side * scale).round().max(1.0) as u32);
    let mut pixels =
        resvg::tiny_skia::Pixmap::new(width, height).ok_or("the picture has no size")?;
    let transform = resvg::tiny_skia::Transform::from_scale(scale, scale);
    resvg::render(&tree, transform, &mut pixels.as_mut());
    Ok(pixels)
}
