//! Drawings that need no script: the residual over the state space, a law against its points, poles of a loop, one
//! number in many recordings.
//!
//! Sizes are in SVG user units; the page scales the drawing to its column. Every text is escaped.

use std::fmt::Write as _;

use crate::contract::Interval;
use crate::expression::{escape, label};
use crate::format;
use crate::page::{Lagged, MechanismPlot, StateMap};
use crate::summary::Pooled;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 350.0;
const LEFT: f64 = 78.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 50.0;

/// Cells of the state-space map, across and upward.
const CELLS: (usize, usize) = (44, 30);
/// Colour steps of the map.
const LEVELS: usize = 16;
/// Most points drawn in a law plot.
const MAX_DOTS: usize = 1500;

/// Viridis (Smith & van der Walt 2015) at nine even steps; between them linear in sRGB.
const VIRIDIS: [[u8; 3]; 9] = [
    [0x44, 0x01, 0x54],
    [0x47, 0x2d, 0x7b],
    [0x3b, 0x52, 0x8b],
    [0x2c, 0x72, 0x8e],
    [0x21, 0x91, 0x8c],
    [0x28, 0xae, 0x80],
    [0x5e, 0xc9, 0x62],
    [0xad, 0xdc, 0x30],
    [0xfd, 0xe7, 0x25],
];

/// Round values (1, 2 or 5 times a power of ten) that cover [low, high] in about `target` steps.
///
/// Returns the ticks inside the range and the number of decimals they need. An empty or not finite range
/// gives no ticks.
pub fn nice_ticks(low: f64, high: f64, target: usize) -> (Vec<f64>, usize) {
    let span = high - low;
    if !span.is_finite() || span <= 0.0 {
        return (Vec::new(), 0);
    }
    let rough = span / target.max(1) as f64;
    let power = 10f64.powf(rough.log10().floor());
    let factor = match rough / power {
        f if f <= 1.0 + 1e-9 => 1.0,
        f if f <= 2.0 + 1e-9 => 2.0,
        f if f <= 5.0 + 1e-9 => 5.0,
        _ => 10.0,
    };
    let step = factor * power;
    let (first, last) = ((low / step - 1e-9).ceil(), (high / step + 1e-9).floor());
    let count = (last - first).clamp(-1.0, 1000.0) as i64 + 1;
    let ticks = (0..count.max(0)).map(|i| (first + i as f64) * step).collect();
    let decimals = (-step.log10().floor()).clamp(0.0, 12.0) as usize;
    (ticks, decimals)
}

fn tick_label(value: f64, decimals: usize) -> String {
    let zero_free = if value.abs() < 0.5 * 10f64.powi(-(decimals as i32)) { 0.0 } else { value };
    if decimals > 5 || value.abs() >= 1e6 {
        return format::significant(zero_free, 2);
    }
    format!("{zero_free:.decimals$}").replace('-', "−")
}

/// The linear map from data to user units of one drawing.
struct Frame {
    x: (f64, f64),
    y: (f64, f64),
    right: f64,
}

impl Frame {
    fn px(&self, x: f64) -> f64 {
        LEFT + (x - self.x.0) / (self.x.1 - self.x.0) * (self.right - LEFT)
    }

    fn py(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - (y - self.y.0) / (self.y.1 - self.y.0) * (HEIGHT - BOTTOM - TOP)
    }

    fn contains(&self, x: f64, y: f64) -> bool {
        x >= self.x.0 && x <= self.x.1 && y >= self.y.0 && y <= self.y.1
    }

    /// Grid, ticks and axis labels.
    fn axes(&self, out: &mut String, x_label: &str, y_label: &str) {
        let base = HEIGHT - BOTTOM;
        let (ticks, decimals) = nice_ticks(self.x.0, self.x.1, 6);
        for tick in ticks {
            let x = self.px(tick);
            let text = tick_label(tick, decimals);
            let _ = write!(
                out,
                "<path class=\"grid\" d=\"M{x:.1} {TOP}V{base}\"/>\
                 <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
                base + 17.0
            );
        }
        let (ticks, decimals) = nice_ticks(self.y.0, self.y.1, 6);
        for tick in ticks {
            let y = self.py(tick);
            let text = tick_label(tick, decimals);
            let _ = write!(
                out,
                "<path class=\"grid\" d=\"M{LEFT} {y:.1}H{:.1}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>",
                self.right,
                LEFT - 7.0,
                y + 4.5
            );
        }
        let _ = write!(
            out,
            "<text class=\"axis\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text class=\"axis\" transform=\"translate(15 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            0.5 * (LEFT + self.right),
            HEIGHT - 10.0,
            escape(&label(x_label)),
            0.5 * (TOP + base),
            escape(&label(y_label)),
        );
    }

    /// Lines where the coordinates are zero, inside the frame.
    fn zeros(&self, out: &mut String) {
        if self.x.0 < 0.0 && self.x.1 > 0.0 {
            let _ =
                write!(out, "<path class=\"zero\" d=\"M{:.1} {TOP}V{}\"/>", self.px(0.0), HEIGHT - BOTTOM);
        }
        if self.y.0 < 0.0 && self.y.1 > 0.0 {
            let _ = write!(out, "<path class=\"zero\" d=\"M{LEFT} {:.1}H{:.1}\"/>", self.py(0.0), self.right);
        }
    }

    /// A line through points; one that is not finite lifts the pen.
    fn line(&self, points: impl IntoIterator<Item = [f64; 2]>) -> String {
        let mut line = String::new();
        let mut pen_down = false;
        for [x, y] in points {
            if x.is_finite() && y.is_finite() {
                let _ =
                    write!(line, "{}{:.1} {:.1}", if pen_down { 'L' } else { 'M' }, self.px(x), self.py(y));
                pen_down = true;
            } else {
                pen_down = false;
            }
        }
        line
    }

    fn border(&self, out: &mut String) {
        let _ = write!(
            out,
            "<path class=\"frame\" d=\"M{LEFT} {TOP}H{r:.1}V{b}H{LEFT}Z\"/>",
            r = self.right,
            b = HEIGHT - BOTTOM
        );
    }
}

fn open(alt: &str) -> String {
    open_at("drawing", WIDTH, HEIGHT, alt)
}

fn open_at(class: &str, width: f64, height: f64, alt: &str) -> String {
    format!(
        "<svg class=\"{class}\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{}\">",
        escape(alt)
    )
}

/// Smallest and largest finite value, widened by `margin` of the range on both sides.
fn range(values: impl Iterator<Item = f64>, margin: f64) -> Option<(f64, f64)> {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for value in values.filter(|value| value.is_finite()) {
        low = low.min(value);
        high = high.max(value);
    }
    if low > high {
        return None;
    }
    let span = high - low;
    let pad = if span > 0.0 { margin * span } else { 0.5 * low.abs().max(1e-12) };
    let widened = (low - pad, high + pad);
    (widened.1 - widened.0).is_finite().then_some(widened)
}

/// The q-quantile of the finite values, 0 ≤ q ≤ 1 (nearest rank).
fn quantile(values: impl Iterator<Item = f64>, q: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    sorted.get((q.clamp(0.0, 1.0) * last as f64).round() as usize).copied()
}

fn viridis(level: f64) -> String {
    let place = level.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f64;
    let index = (place as usize).min(VIRIDIS.len() - 2);
    let part = place - index as f64;
    let mut hex = String::from("#");
    for (a, b) in VIRIDIS[index].iter().zip(VIRIDIS[index + 1]) {
        let mixed = f64::from(*a) + part * (f64::from(b) - f64::from(*a));
        let _ = write!(hex, "{:02x}", mixed.round() as u8);
    }
    hex
}

/// The residual over the state space: the RMS of the values in each cell of a grid as colour, from zero to
/// the 98 % quantile of the cells. `None` when no point is finite.
pub fn state_map(map: &StateMap, alt: &str) -> Option<String> {
    let points: Vec<(f64, f64, f64)> = map
        .x
        .iter()
        .zip(&map.y)
        .zip(&map.value)
        .map(|((&x, &y), &value)| (x, y, value))
        .filter(|(x, y, value)| x.is_finite() && y.is_finite() && value.is_finite())
        .collect();
    let frame = Frame {
        x: range(points.iter().map(|p| p.0), 0.0)?,
        y: range(points.iter().map(|p| p.1), 0.0)?,
        right: WIDTH - 100.0,
    };
    let (columns, rows) = CELLS;
    let cell = |value: f64, (low, high): (f64, f64), count: usize| {
        (((value - low) / (high - low) * count as f64) as usize).min(count - 1)
    };
    let mut sums = vec![(0.0, 0u32); columns * rows];
    for &(x, y, value) in &points {
        let sum = &mut sums[cell(y, frame.y, rows) * columns + cell(x, frame.x, columns)];
        sum.0 += value * value;
        sum.1 += 1;
    }
    let rms = |&(sum, count): &(f64, u32)| (count > 0).then(|| (sum / f64::from(count)).sqrt());
    let top = quantile(sums.iter().filter_map(rms), 0.98)?;
    let top = if top > 0.0 && top.is_finite() { top } else { 1.0 };

    let mut paths = vec![String::new(); LEVELS];
    let (w, h) = ((frame.right - LEFT) / columns as f64, (HEIGHT - BOTTOM - TOP) / rows as f64);
    for (index, sum) in sums.iter().enumerate() {
        let Some(value) = rms(sum) else { continue };
        let level = ((value / top * LEVELS as f64) as usize).min(LEVELS - 1);
        let x = LEFT + (index % columns) as f64 * w;
        let y = HEIGHT - BOTTOM - ((index / columns) as f64 + 1.0) * h;
        let _ = write!(paths[level], "M{x:.1} {y:.1}h{:.1}v{:.1}h-{0:.1}z", w + 0.15, h + 0.15);
    }
    let mut out = open(alt);
    frame.axes(&mut out, &map.x_label, &map.y_label);
    for (level, path) in paths.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
        let colour = viridis((level as f64 + 0.5) / LEVELS as f64);
        let _ = write!(out, "<path fill=\"{colour}\" d=\"{path}\"/>");
    }
    frame.border(&mut out);
    colour_bar(&mut out, top, &map.value_label);
    out.push_str("</svg>");
    Some(out)
}

fn colour_bar(out: &mut String, top: f64, value_label: &str) {
    let (x, width) = (WIDTH - 90.0, 13.0);
    let height = HEIGHT - BOTTOM - TOP;
    let step = height / LEVELS as f64;
    for level in 0..LEVELS {
        let y = HEIGHT - BOTTOM - (level as f64 + 1.0) * step;
        let colour = viridis((level as f64 + 0.5) / LEVELS as f64);
        let _ =
            write!(out, "<path fill=\"{colour}\" d=\"M{x} {y:.1}h{width}v{:.1}h-{width}z\"/>", step + 0.15);
    }
    let (ticks, decimals) = nice_ticks(0.0, top, 4);
    for tick in ticks {
        let y = HEIGHT - BOTTOM - tick / top * height;
        let text = tick_label(tick, decimals);
        let _ = write!(out, "<text x=\"{}\" y=\"{:.1}\">{text}</text>", x + width + 5.0, y + 4.5);
    }
    let _ = write!(
        out,
        "<text class=\"axis\" transform=\"translate({} {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        WIDTH - 6.0,
        TOP + 0.5 * height,
        escape(&label(value_label))
    );
}

/// A drawing of a law and how many of its points lie outside the frame.
#[derive(Debug, Clone, PartialEq)]
pub struct LawPlot {
    /// The SVG element.
    pub svg: String,
    /// Points beyond the drawn range.
    pub outside: usize,
    /// Points beyond the number that is drawn (every k-th is).
    pub every: usize,
}

/// The estimated force as dots and the fitted law as a line. The frame covers the law and the central 99 %
/// of the points; `None` when neither has a finite point.
pub fn law_plot(plot: &MechanismPlot, alt: &str) -> Option<LawPlot> {
    let finite: Vec<[f64; 2]> =
        plot.points.iter().copied().filter(|[x, y]| x.is_finite() && y.is_finite()).collect();
    let central = |axis: usize| {
        let low = quantile(finite.iter().map(|p| p[axis]), 0.005);
        let high = quantile(finite.iter().map(|p| p[axis]), 0.995);
        low.into_iter().chain(high)
    };
    let frame = Frame {
        x: range(central(0).chain(plot.curve.iter().map(|p| p[0])), 0.03)?,
        y: range(central(1).chain(plot.curve.iter().map(|p| p[1])), 0.06)?,
        right: WIDTH - 12.0,
    };
    let mut out = open(alt);
    frame.axes(&mut out, &plot.x_label, &plot.y_label);
    frame.zeros(&mut out);
    let every = finite.len().div_ceil(MAX_DOTS).max(1);
    let mut dots = String::new();
    for &[x, y] in finite.iter().step_by(every).filter(|[x, y]| frame.contains(*x, *y)) {
        let _ = write!(dots, "M{:.1} {:.1}h0", frame.px(x), frame.py(y));
    }
    if !dots.is_empty() {
        let _ = write!(out, "<path class=\"dots\" d=\"{dots}\"/>");
    }
    let line = frame.line(plot.curve.iter().copied());
    if !line.is_empty() {
        let _ = write!(out, "<path class=\"halo\" d=\"{line}\"/><path class=\"law\" d=\"{line}\"/>");
    }
    frame.border(&mut out);
    out.push_str("</svg>");
    let outside = finite.iter().filter(|[x, y]| !frame.contains(*x, *y)).count();
    Some(LawPlot { svg: out, outside, every })
}

/// A correlation over its lag, the calibrated model's dashed, and the band that chance stays in. `None` when no value
/// is finite.
pub fn correlation_plot(found: &Lagged, alt: &str) -> Option<String> {
    let values = || found.before.iter().chain(&found.after).copied();
    values().find(|v| v.is_finite())?;
    let frame = Frame {
        x: range(found.lag.iter().copied(), 0.03)?,
        y: range(values().chain([found.bound, -found.bound]), 0.08)?,
        right: WIDTH - 12.0,
    };
    let mut out = open(alt);
    frame.axes(&mut out, "lag in s", "correlation");
    let _ = write!(
        out,
        "<path class=\"chance\" d=\"M{LEFT} {:.1}H{:.1}V{:.1}H{LEFT}Z\"/>",
        frame.py(found.bound),
        frame.right,
        frame.py(-found.bound)
    );
    frame.zeros(&mut out);
    for (class, values) in [("before", &found.before), ("law", &found.after)] {
        let line = frame.line(found.lag.iter().zip(values).map(|(lag, value)| [*lag, *value]));
        if !line.is_empty() {
            let _ = write!(out, "<path class=\"{class}\" d=\"{line}\"/>");
        }
    }
    frame.border(&mut out);
    out.push_str("</svg>");
    Some(out)
}

/// Two estimates of one number on one scale, before above after, with their intervals. A picture of what the row beside
/// it says in numbers: nothing for a screen reader. `None` where a value or an interval is missing.
pub fn change_plot(before: (f64, Option<Interval>), after: (f64, Option<Interval>)) -> Option<String> {
    const SIZE: (f64, f64) = (132.0, 30.0);
    let (a, b) = (before.1?, after.1?);
    let all = [before.0, a.low, a.high, after.0, b.low, b.high];
    let (low, high) = range(all.into_iter(), 0.08).filter(|_| all.iter().all(|v| v.is_finite()))?;
    let px = |x: f64| (x - low) / (high - low) * SIZE.0;
    let mut out =
        format!("<svg class=\"change\" viewBox=\"0 0 {} {}\" aria-hidden=\"true\">", SIZE.0, SIZE.1);
    for (class, y, value, ci) in [("before", 9.0, before.0, a), ("after", 21.0, after.0, b)] {
        let (from, to, x) = (px(ci.low), px(ci.high), px(value));
        let _ = write!(
            out,
            "<path class=\"{class}\" d=\"M{from:.1} {y}H{to:.1}M{from:.1} {}v6M{to:.1} {}v6\"/>\
             <circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y}\" r=\"3\"/>",
            y - 3.0,
            y - 3.0
        );
    }
    out.push_str("</svg>");
    Some(out)
}

/// A plane of poles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Plane {
    /// s: stable left of the imaginary axis.
    Continuous,
    /// z: stable inside the unit circle.
    Sampled,
}

/// Marks of the groups of a pole plot, as text and as paths around the pole.
const MARKS: [(&str, &str); 4] = [
    ("×", "m-5 -5l10 10m-10 0l10 -10"),
    ("+", "m-6 0h12m-6 -6v12"),
    ("□", "m-5 -5h10v10h-10z"),
    ("◇", "m0 -6l6 6l-6 6l-6 -6z"),
];

/// The mark of a group, for a key.
pub fn pole_mark(group: usize) -> &'static str {
    MARKS[group % MARKS.len()].0
}

/// Poles (real, imaginary part) as groups of marks. Both axes of the z plane have the same scale; of the unit circle what
/// lies in the frame is drawn. `None` when no pole is finite.
pub fn pole_plot(groups: &[&[[f64; 2]]], plane: Plane, alt: &str) -> Option<String> {
    let poles = || groups.iter().flat_map(|g| g.iter()).filter(|p| p[0].is_finite() && p[1].is_finite());
    poles().next()?;
    let edge = if plane == Plane::Continuous { 0.0 } else { 1.0 };
    let mut x = range(poles().map(|p| p[0]).chain([edge]), 0.12)?;
    let mut y = range(poles().flat_map(|p| [p[1], -p[1]]), 0.15)?;
    let right = WIDTH - 12.0;
    if plane == Plane::Continuous {
        // Real poles alone leave no height.
        let least = 0.1 * (x.1 - x.0);
        y = (y.0.min(-least), y.1.max(least));
    } else {
        let shape = (right - LEFT) / (HEIGHT - BOTTOM - TOP);
        let (wide, tall) = (x.1 - x.0, y.1 - y.0);
        let wanted = wide.max(tall * shape);
        let (more_x, more_y) = (0.5 * (wanted - wide), 0.5 * (wanted / shape - tall));
        (x, y) = ((x.0 - more_x, x.1 + more_x), (y.0 - more_y, y.1 + more_y));
    }
    let frame = Frame { x, y, right };
    let mut out = open(alt);
    let (across, upward) = match plane {
        Plane::Continuous => ("real part [1/s]", "imaginary part [1/s]"),
        Plane::Sampled => ("real part", "imaginary part"),
    };
    frame.axes(&mut out, across, upward);
    if frame.y.0 < 0.0 && frame.y.1 > 0.0 {
        let _ = write!(out, "<path class=\"zero\" d=\"M{LEFT} {:.1}H{:.1}\"/>", frame.py(0.0), frame.right);
    }
    match plane {
        Plane::Continuous => {
            let _ =
                write!(out, "<path class=\"edge\" d=\"M{:.1} {TOP}V{}\"/>", frame.px(0.0), HEIGHT - BOTTOM);
        }
        Plane::Sampled => {
            let _ = write!(out, "<path class=\"edge\" d=\"{}\"/>", unit_circle(&frame));
        }
    }
    for (k, group) in groups.iter().enumerate() {
        let mark = MARKS[k % MARKS.len()].1;
        let mut path = String::new();
        for &[x, y] in group.iter().filter(|[x, y]| frame.contains(*x, *y)) {
            let _ = write!(path, "M{:.1} {:.1}{mark}", frame.px(x), frame.py(y));
        }
        let _ = write!(out, "<path class=\"pole pole-{}\" d=\"{path}\"/>", k % MARKS.len());
    }
    frame.border(&mut out);
    out.push_str("</svg>");
    Some(out)
}

/// What of the unit circle lies in the frame, with more points where the frame is small.
fn unit_circle(frame: &Frame) -> String {
    let full = std::f64::consts::PI;
    let span = (frame.y.1 - frame.y.0).max(frame.x.1 - frame.x.0);
    let steps = ((600.0 / span.max(1e-3)) as usize).clamp(400, 200_000);
    let mut path = String::new();
    let mut last: Option<(f64, f64)> = None;
    for k in 0..=steps {
        let angle = -full + 2.0 * full * k as f64 / steps as f64;
        let (x, y) = (angle.cos(), angle.sin());
        if !frame.contains(x, y) {
            last = None;
            continue;
        }
        let place = (frame.px(x), frame.py(y));
        match last {
            Some((px, py)) if (place.0 - px).hypot(place.1 - py) < 2.0 => continue,
            Some(_) => path.push('L'),
            None => path.push('M'),
        }
        let _ = write!(path, "{:.1} {:.1}", place.0, place.1);
        last = Some(place);
    }
    path
}

/// Width of a forest plot, that of its names, and the height of a row.
const FOREST: (f64, f64, f64) = (440.0, 130.0, 20.0);
/// Most characters of a name.
const NAME: usize = 16;

/// A forest plot: estimates of one number with their 95 % intervals, one per row, and the pooled one as a diamond
/// with a line through all rows. `None` when no value is finite.
pub fn forest_plot(pooled: &Pooled, x_label: &str, alt: &str) -> Option<String> {
    let (width, left, row) = FOREST;
    let right = width - 14.0;
    let bottom = TOP + row * (pooled.estimates.len() + 1) as f64;
    let all = || {
        let estimates = pooled.estimates.iter().map(|e| (e.value, e.ci95));
        estimates.chain([(pooled.value, pooled.ci95)])
    };
    let ends = |(value, ci): (f64, Option<Interval>)| ci.map_or([value; 3], |ci| [value, ci.low, ci.high]);
    let (low, high) = range(all().flat_map(ends), 0.04)?;
    let px = |x: f64| left + (x - low) / (high - low) * (right - left);
    let mut out = open_at("drawing forest", width, bottom + BOTTOM, alt);
    let (ticks, decimals) = nice_ticks(low, high, 5);
    for tick in ticks {
        let (x, text) = (px(tick), tick_label(tick, decimals));
        let _ = write!(
            out,
            "<path class=\"grid\" d=\"M{x:.1} {TOP}V{bottom}\"/>\
             <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
            bottom + 17.0
        );
    }
    if pooled.value.is_finite() {
        let _ = write!(out, "<path class=\"zero\" d=\"M{:.1} {TOP}V{bottom}\"/>", px(pooled.value));
    }
    for (k, e) in pooled.estimates.iter().enumerate() {
        let y = TOP + row * (k as f64 + 0.5);
        name(&mut out, left, y, &e.recording);
        if let Some(ci) = e.ci95.filter(|ci| ci.low.is_finite() && ci.high.is_finite()) {
            let _ =
                write!(out, "<path class=\"whisker\" d=\"M{:.1} {y:.1}H{:.1}\"/>", px(ci.low), px(ci.high));
        }
        if e.value.is_finite() {
            let _ =
                write!(out, "<path class=\"mark\" d=\"M{:.1} {:.1}v7h-7v-7z\"/>", px(e.value) + 3.5, y - 3.5);
        }
    }
    let y = bottom - 0.5 * row;
    name(&mut out, left, y, "pooled");
    if let Some(ci) = pooled.ci95.filter(|_| pooled.value.is_finite()) {
        let (a, m, b) = (px(ci.low), px(pooled.value), px(ci.high));
        // Never narrower than a mark.
        let (a, b) = (a.min(m - 4.0), b.max(m + 4.0));
        let _ = write!(
            out,
            "<path class=\"diamond\" d=\"M{a:.1} {y:.1}L{m:.1} {:.1}L{b:.1} {y:.1}L{m:.1} {:.1}Z\"/>",
            y - 6.0,
            y + 6.0
        );
    }
    let _ = write!(
        out,
        "<path class=\"frame\" d=\"M{left} {TOP}H{right}V{bottom}H{left}Z\"/>\
         <text class=\"axis\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text></svg>",
        0.5 * (left + right),
        bottom + BOTTOM - 12.0,
        escape(&label(x_label))
    );
    Some(out)
}

/// The name of a row, its middle left out where it is long: names often differ at their ends.
fn name(out: &mut String, left: f64, y: f64, full: &str) {
    let letters: Vec<char> = full.chars().collect();
    let shown: String = if letters.len() > NAME {
        let (head, tail) = (NAME / 2, NAME - NAME / 2 - 1);
        letters[..head].iter().chain(&['…']).chain(&letters[letters.len() - tail..]).collect()
    } else {
        full.to_owned()
    };
    let _ = write!(
        out,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
        left - 8.0,
        y + 4.5,
        escape(&shown)
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_correlation_has_a_line_of_each_model_and_the_band_of_chance() {
        let found = Lagged {
            with: None,
            lag: vec![0.1, 0.2, 0.3],
            before: vec![0.5, 0.2, 0.1],
            after: vec![0.05, -0.02, 0.01],
            bound: 0.06,
        };
        let svg = correlation_plot(&found, "a < b").unwrap();
        assert!(svg.contains("a &lt; b") && svg.contains("class=\"chance\""));
        assert_eq!(svg.matches('L').count(), 4, "two lines of three points each");
        let empty = Lagged { before: Vec::new(), after: vec![f64::NAN; 3], ..found };
        assert_eq!(correlation_plot(&empty, ""), None);
    }

    #[test]
    fn ticks_are_round() {
        let (ticks, decimals) = nice_ticks(-0.32, 0.47, 6);
        assert_eq!(decimals, 1);
        let labels: Vec<String> = ticks.iter().map(|&t| tick_label(t, decimals)).collect();
        assert_eq!(labels, ["−0.2", "0.0", "0.2", "0.4"]);
        assert!(nice_ticks(1.0, 1.0, 5).0.is_empty());
        assert!(nice_ticks(f64::NAN, 1.0, 5).0.is_empty());
        assert!(nice_ticks(-f64::MAX, f64::MAX, 5).0.is_empty());
    }

    #[test]
    fn nothing_finite_draws_nothing_and_one_point_draws() {
        let mut map = StateMap {
            x_label: "x".into(),
            y_label: "y".into(),
            value_label: "r".into(),
            x: vec![f64::NAN],
            y: vec![0.0],
            value: vec![1.0],
        };
        assert_eq!(state_map(&map, ""), None);
        map.x = vec![0.0];
        map.value = vec![0.0];
        let svg = state_map(&map, "a \"map\"").unwrap();
        assert!(svg.contains("a &quot;map&quot;") && !svg.contains("NaN"), "{svg}");
    }

    #[test]
    fn the_map_shows_where_the_residual_is_large() {
        let n = 2000;
        let x: Vec<f64> = (0..n).map(|i| (i as f64 * 0.7).sin()).collect();
        let y: Vec<f64> = (0..n).map(|i| (i as f64 * 0.31).cos()).collect();
        let value: Vec<f64> = x.iter().map(|&x| if x > 0.8 { 5.0 } else { 0.0 }).collect();
        let map = StateMap { x_label: "x".into(), y_label: "y".into(), value_label: "r".into(), x, y, value };
        let svg = state_map(&map, "").unwrap();
        let bright = viridis(1.0 - 0.5 / LEVELS as f64);
        let cells = svg.split("<path").find(|p| p.contains(&bright)).unwrap();
        let left = cells.split('M').skip(1).filter_map(|m| m.split(' ').next()?.parse::<f64>().ok());
        assert!(left.fold(f64::INFINITY, f64::min) > 0.8 * (WIDTH - 92.0), "only the right end is bright");
    }

    #[test]
    fn an_outlier_does_not_squash_the_law() {
        let mut points: Vec<[f64; 2]> = (0..1000).map(|i| [i as f64 / 1000.0, 0.1]).collect();
        points[5][1] = 1e9;
        points.push([f64::NAN, 1.0]);
        let plot = MechanismPlot {
            mechanism: Some(0),
            title: String::new(),
            x_label: "x".into(),
            y_label: "f".into(),
            points,
            curve: vec![[0.0, 0.0], [f64::NAN, 0.0], [1.0, 0.2]],
        };
        let drawn = law_plot(&plot, "").unwrap();
        // Beyond the frame: the outlier only, the frame reaches past the 99 % of x.
        assert_eq!((drawn.outside, drawn.every), (1, 1));
        assert!(!drawn.svg.contains("NaN"));
    }

    #[test]
    fn a_forest_has_a_row_for_each_estimate_and_its_pooled_value() {
        use crate::summary::{Method, RecordingEstimate};
        let estimate = |recording: &str, value: f64, ci95: Option<Interval>| RecordingEstimate {
            recording: recording.into(),
            value,
            ci95,
        };
        let mut pooled = Pooled {
            value: 2.0,
            ci95: Some(Interval::new(1.8, 2.2)),
            unit: "N".into(),
            method: Method::FixedEffect,
            heterogeneity: None,
            estimates: vec![
                estimate("<a>.csv", 1.0, Some(Interval::new(0.5, 1.5))),
                estimate("a_recording_of_monday_morning.csv", 3.0, None),
            ],
            machines: None,
        };
        let svg = forest_plot(&pooled, "fc [N]", "a \"forest\"").unwrap();
        assert_eq!((svg.matches("class=\"mark\"").count(), svg.matches("class=\"whisker\"").count()), (2, 1));
        assert_eq!(svg.matches("class=\"diamond\"").count(), 1);
        assert!(svg.contains("&lt;a&gt;.csv") && svg.contains(">a_record…ing.csv<"), "{svg}");
        assert!(svg.contains("a &quot;forest&quot;") && !svg.contains("NaN"), "{svg}");
        // Ends of intervals may be unknown.
        pooled.estimates[0].ci95 = Some(Interval::new(f64::NAN, 1.5));
        assert!(!forest_plot(&pooled, "", "").unwrap().contains("NaN"));
        pooled.value = f64::NAN;
        pooled.ci95 = None;
        pooled.estimates.clear();
        assert_eq!(forest_plot(&pooled, "", ""), None);
    }
}
