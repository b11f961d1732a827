//! Plots as SVG: lines and points over linear or logarithmic axes.
//!
//! One call, one self-contained `<svg>` with its own style, fit for a page and for a file of its own. Series
//! are labelled where they end, so that a plot reads without a legend to look up.

use std::fmt::Write as _;

use greybox_report::expression::escape;
use greybox_report::svg::nice_ticks;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 380.0;
const LEFT: f64 = 88.0;
const TOP: f64 = 16.0;
const BOTTOM: f64 = 54.0;
const MARGIN: f64 = 14.0;
/// Width of a character of a label, about.
const CHARACTER: f64 = 7.1;
const LINE: f64 = 16.0;

/// Okabe & Ito (2008), told apart by colour-blind readers as well; yellow and light blue left out.
const COLOURS: [&str; 6] = ["#0072b2", "#d55e00", "#009e73", "#000000", "#cc79a7", "#8a6d00"];

const STYLE: &str = "svg.plot{font:13.5px system-ui,'Liberation Sans',sans-serif;fill:#1d232b;max-width:100%}\
svg.plot .grid{stroke:#e3e7ec;fill:none}svg.plot .frame{stroke:#8b95a3;fill:none}\
svg.plot .axis{font-size:14px}svg.plot .halo{stroke:#fff;stroke-width:4;paint-order:stroke}";

/// How an axis maps values to places.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scale {
    /// Equal steps.
    #[default]
    Linear,
    /// Equal factors; values that are not positive are not drawn.
    Log,
}

/// An axis.
#[derive(Debug, Clone, Default)]
pub struct Axis {
    /// What it shows, with its unit.
    pub title: String,
    /// Its scale.
    pub scale: Scale,
    /// Its ends; by the data where not given.
    pub range: Option<(f64, f64)>,
    /// Whether only whole numbers are marked.
    pub whole: bool,
}

impl Axis {
    /// A linear axis by the data.
    pub fn linear(title: impl Into<String>) -> Self {
        Self { title: title.into(), ..Self::default() }
    }

    /// A linear axis by the data that counts something.
    pub fn whole(title: impl Into<String>) -> Self {
        Self { title: title.into(), whole: true, ..Self::default() }
    }

    /// A logarithmic axis by the data.
    pub fn log(title: impl Into<String>) -> Self {
        Self { title: title.into(), scale: Scale::Log, ..Self::default() }
    }
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// A line.
    Line,
    /// A dashed line.
    Dashed,
    /// Points.
    Points,
    /// Points joined by a line.
    Joined,
}

/// A series of points.
#[derive(Debug, Clone)]
pub struct Series {
    /// Written where the series ends; empty for none.
    pub label: String,
    /// (x, y); a value that is not finite breaks the line.
    pub points: Vec<[f64; 2]>,
    /// Lower and upper ends of error bars, one for each point, or none.
    pub errors: Vec<(f64, f64)>,
    /// How it is drawn.
    pub style: Style,
}

impl Series {
    /// A series without error bars.
    pub fn new(label: impl Into<String>, style: Style, points: Vec<[f64; 2]>) -> Self {
        Self { label: label.into(), points, errors: Vec::new(), style }
    }

    /// With error bars between these ends, one for each point.
    pub fn with_errors(self, errors: Vec<(f64, f64)>) -> Self {
        Self { errors, ..self }
    }

    fn bars(&self) -> impl Iterator<Item = ([f64; 2], (f64, f64))> {
        self.points.iter().copied().zip(self.errors.iter().copied())
    }
}

/// A plot.
#[derive(Debug, Clone)]
pub struct Plot {
    /// What it shows, for readers who cannot see it.
    pub alt: String,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// What is drawn, the first at the bottom.
    pub series: Vec<Series>,
}

/// An axis with its ends and places on the drawing.
struct Mapped {
    scale: Scale,
    whole: bool,
    ends: (f64, f64),
    places: (f64, f64),
}

impl Mapped {
    /// `None` where nothing can be drawn: no finite (for logarithms: positive) value.
    fn new(axis: &Axis, values: impl Iterator<Item = f64>, places: (f64, f64)) -> Option<Self> {
        let on = |v: f64| if axis.scale == Scale::Log { v.log10() } else { v };
        let ends = match axis.range {
            Some((low, high)) => (on(low), on(high)),
            None => {
                let finite = values.map(on).filter(|v| v.is_finite());
                let (low, high) =
                    finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
                let pad = if high > low { 0.04 * (high - low) } else { 0.5 * low.abs().max(1e-3) };
                (low - pad, high + pad)
            }
        };
        (ends.0.is_finite() && ends.1.is_finite() && ends.1 > ends.0).then_some(Self {
            scale: axis.scale,
            whole: axis.whole,
            ends,
            places,
        })
    }

    fn place(&self, value: f64) -> f64 {
        let value = if self.scale == Scale::Log { value.log10() } else { value };
        let part = (value - self.ends.0) / (self.ends.1 - self.ends.0);
        self.places.0 + part * (self.places.1 - self.places.0)
    }

    fn holds(&self, value: f64) -> bool {
        let value = if self.scale == Scale::Log { value.log10() } else { value };
        value >= self.ends.0 && value <= self.ends.1
    }

    /// Places and labels of the ticks.
    fn ticks(&self) -> Vec<(f64, String)> {
        let (low, high) = self.ends;
        if self.scale == Scale::Log && high - low >= 1.0 {
            let every = ((high - low) / 8.0).ceil().max(1.0) as i32;
            let decades = (low.ceil() as i32..=high.floor() as i32).filter(|d| d.rem_euclid(every) == 0);
            return decades.map(|d| (self.place(10f64.powi(d)), power_of_ten(d))).collect();
        }
        let (low, high) =
            if self.scale == Scale::Log { (10f64.powf(low), 10f64.powf(high)) } else { (low, high) };
        let (mut ticks, mut decimals) = nice_ticks(low, high, 7);
        if self.whole {
            ticks.retain(|t| (t - t.round()).abs() < 1e-9);
            decimals = 0;
        }
        ticks.into_iter().map(|t| (self.place(t), number(t, decimals))).collect()
    }
}

fn power_of_ten(decade: i32) -> String {
    let superscript = |c: char| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32(0x2070 + digit.to_digit(10).unwrap_or(0)).unwrap_or(digit),
    };
    match decade {
        0 => "1".into(),
        1 => "10".into(),
        _ => format!("10{}", decade.to_string().chars().map(superscript).collect::<String>()),
    }
}

fn number(value: f64, decimals: usize) -> String {
    let value = if value.abs() < 0.5 * 10f64.powi(-(decimals as i32)) { 0.0 } else { value };
    if value.abs() >= 1e6 || decimals > 5 {
        return format!("{value:.1e}").replace('-', "−");
    }
    format!("{value:.decimals$}").replace('-', "−")
}

/// The opening tag with style and description; the caller closes it.
pub fn open(width: f64, height: f64, alt: &str) -> String {
    format!(
        "<svg class=\"plot\" xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
         width=\"{width}\" role=\"img\" aria-label=\"{}\"><style>{STYLE}</style>",
        escape(alt)
    )
}

impl Plot {
    /// The drawing; `None` where no series has a point that can be drawn.
    pub fn to_svg(&self) -> Option<String> {
        let longest = self.series.iter().map(|s| s.label.chars().count()).max().unwrap_or(0);
        let right =
            WIDTH - MARGIN - (longest as f64 * CHARACTER + 8.0 * f64::from(longest > 0)).min(0.35 * WIDTH);
        let points = || self.series.iter().flat_map(|s| s.points.iter().copied());
        let ends = self.series.iter().flat_map(|s| s.bars().flat_map(|(_, (low, high))| [low, high]));
        let x = Mapped::new(&self.x, points().map(|p| p[0]), (LEFT, right))?;
        let y = Mapped::new(&self.y, points().map(|p| p[1]).chain(ends), (HEIGHT - BOTTOM, TOP))?;
        if !points().any(|[px, py]| x.holds(px) && y.holds(py)) {
            return None;
        }

        let mut out = open(WIDTH, HEIGHT, &self.alt);
        self.axes(&mut out, &x, &y);
        let mut labels: Vec<(f64, f64, usize)> = Vec::new();
        for (k, series) in self.series.iter().enumerate() {
            draw(&mut out, series, COLOURS[k % COLOURS.len()], &x, &y);
            let last = series.points.iter().rev().find(|p| x.holds(p[0]) && y.holds(p[1]));
            if let Some(last) = last.filter(|_| !series.label.is_empty()) {
                labels.push((y.place(last[1]), x.place(last[0]), k));
            }
        }
        self.labels(&mut out, labels, right);
        out.push_str("</svg>");
        Some(out)
    }

    fn axes(&self, out: &mut String, x: &Mapped, y: &Mapped) {
        let (base, right) = (HEIGHT - BOTTOM, x.places.1);
        for (place, text) in x.ticks() {
            let _ = write!(
                out,
                "<path class=\"grid\" d=\"M{place:.1} {TOP}V{base}\"/>\
                 <text x=\"{place:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
                base + 18.0
            );
        }
        for (place, text) in y.ticks() {
            let _ = write!(
                out,
                "<path class=\"grid\" d=\"M{LEFT} {place:.1}H{right:.1}\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>",
                LEFT - 7.0,
                place + 4.5
            );
        }
        let _ = write!(
            out,
            "<path class=\"frame\" d=\"M{LEFT} {TOP}H{right:.1}V{base}H{LEFT}Z\"/>\
             <text class=\"axis\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text class=\"axis\" transform=\"translate(17 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            0.5 * (LEFT + right),
            HEIGHT - 11.0,
            escape(&self.x.title),
            0.5 * (TOP + base),
            escape(&self.y.title)
        );
    }

    /// The labels right of the frame at the height where their series end, moved apart where they would meet.
    fn labels(&self, out: &mut String, mut labels: Vec<(f64, f64, usize)>, right: f64) {
        labels.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut places: Vec<f64> = Vec::new();
        for (wanted, ..) in &labels {
            let least = places.last().map_or(TOP + 8.0, |last| last + LINE);
            places.push(wanted.max(least));
        }
        let mut most = HEIGHT - BOTTOM;
        for place in places.iter_mut().rev() {
            *place = place.min(most);
            most = *place - LINE;
        }
        for ((end, from, k), place) in labels.iter().zip(places) {
            let colour = COLOURS[k % COLOURS.len()];
            let _ = write!(
                out,
                "<path d=\"M{:.1} {end:.1}H{right:.1}L{:.1} {place:.1}\" fill=\"none\" stroke=\"{colour}\" \
                 stroke-width=\"0.7\" opacity=\"0.6\"/><text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\">{}</text>",
                from + 5.0,
                right + 6.0,
                right + 9.0,
                place + 4.5,
                escape(&self.series[*k].label)
            );
        }
    }
}

fn draw(out: &mut String, series: &Series, colour: &str, x: &Mapped, y: &Mapped) {
    let (mut line, mut dots, mut bars) = (String::new(), String::new(), String::new());
    let mut pen_down = false;
    for &[px, py] in &series.points {
        // Outside the frame the line breaks: nothing is drawn beyond the axes.
        if !(x.holds(px) && y.holds(py)) {
            pen_down = false;
            continue;
        }
        let _ = write!(line, "{}{:.1} {:.1}", if pen_down { 'L' } else { 'M' }, x.place(px), y.place(py));
        let _ = write!(dots, "M{:.1} {:.1}h0", x.place(px), y.place(py));
        pen_down = true;
    }
    for ([px, _], (low, high)) in series.bars().filter(|([px, py], _)| x.holds(*px) && y.holds(*py)) {
        // A bar that reaches below zero ends at the frame of a logarithmic axis.
        let low = if y.holds(low) { y.place(low) } else { y.places.0 };
        let high = if y.holds(high) { y.place(high) } else { y.places.1 };
        let place = x.place(px);
        let _ =
            write!(bars, "M{place:.1} {low:.1}V{high:.1}M{:.1} {low:.1}h8M{0:.1} {high:.1}h8", place - 4.0);
    }
    let dash = if series.style == Style::Dashed { " stroke-dasharray=\"6 4\"" } else { "" };
    if series.style != Style::Points {
        let _ =
            write!(out, "<path d=\"{line}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.8\"{dash}/>");
    }
    if !bars.is_empty() {
        let _ = write!(out, "<path d=\"{bars}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.2\"/>");
    }
    if matches!(series.style, Style::Points | Style::Joined) {
        let _ = write!(
            out,
            "<path d=\"{dots}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"7\" stroke-linecap=\"round\"/>"
        );
    }
}

/// A map of values over two variables, `values[row][column]` with the first row at the bottom, with its scale: from
/// white to blue where no value is negative, else from blue over white at zero to red.
pub fn surface_map(
    alt: &str,
    (x, x_ends): (&str, (f64, f64)),
    (y, y_ends): (&str, (f64, f64)),
    values: &[Vec<f64>],
) -> String {
    const SIDE: f64 = 300.0;
    let largest = values.iter().flatten().map(|v| v.abs()).fold(0.0, f64::max);
    let signed = values.iter().flatten().any(|v| *v < 0.0);
    let colour = |value: f64| {
        let part = if largest > 0.0 { (value.abs() / largest).min(1.0) } else { 0.0 };
        let [r, g, b] = if value < 0.0 || !signed { [0.0, 114.0, 178.0] } else { [213.0, 94.0, 0.0] };
        let mix = |c: f64| (255.0 + part * (c - 255.0)).round();
        format!("rgb({},{},{})", mix(r), mix(g), mix(b))
    };
    let mut out = open(SIDE + LEFT + 150.0, SIDE + TOP + BOTTOM, alt);
    let (rows, columns) = (values.len().max(1) as f64, values.first().map_or(1, Vec::len).max(1) as f64);
    let (width, height) = (SIDE / columns, SIDE / rows);
    for (j, row) in values.iter().enumerate() {
        for (i, value) in row.iter().enumerate() {
            let _ = write!(
                out,
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{}\"/>",
                LEFT + i as f64 * width,
                TOP + SIDE - (j + 1) as f64 * height,
                width + 0.3,
                height + 0.3,
                colour(*value)
            );
        }
    }
    for k in 0..=4 {
        let part = f64::from(k) / 4.0;
        let label = |ends: (f64, f64)| number(ends.0 + part * (ends.1 - ends.0), 1);
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            LEFT + part * SIDE,
            TOP + SIDE + 18.0,
            label(x_ends),
            LEFT - 7.0,
            TOP + SIDE * (1.0 - part) + 4.5,
            label(y_ends)
        );
    }
    // The scale.
    let (low, steps) = (if signed { -largest } else { 0.0 }, 24);
    for k in 0..steps {
        let value = low + (largest - low) * (f64::from(k) + 0.5) / f64::from(steps);
        let tall = SIDE / f64::from(steps);
        let _ = write!(
            out,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"18\" height=\"{:.1}\" fill=\"{}\"/>",
            LEFT + SIDE + 24.0,
            TOP + SIDE - f64::from(k + 1) * tall,
            tall + 0.3,
            colour(value)
        );
    }
    for (value, place) in [(low, TOP + SIDE), (0.5 * (low + largest), TOP + 0.5 * SIDE), (largest, TOP + 9.0)]
    {
        let text = if value == 0.0 || (1e-2..1e4).contains(&value.abs()) {
            number(value, 2)
        } else {
            format!("{value:.1e}").replace('-', "−")
        };
        let _ = write!(out, "<text x=\"{:.1}\" y=\"{place:.1}\">{text}</text>", LEFT + SIDE + 48.0);
    }
    let _ = write!(
        out,
        "<path class=\"frame\" d=\"M{LEFT} {TOP}h{SIDE}v{SIDE}h-{SIDE}z\"/>\
         <text class=\"axis\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
         <text class=\"axis\" transform=\"translate(17 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text></svg>",
        LEFT + 0.5 * SIDE,
        TOP + SIDE + 42.0,
        escape(x),
        TOP + 0.5 * SIDE,
        escape(y)
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(y: Axis, points: Vec<[f64; 2]>) -> Plot {
        let series = vec![Series::new("a < b", Style::Joined, points)];
        Plot { alt: "A plot".into(), x: Axis::linear("order"), y, series }
    }

    #[test]
    fn a_logarithmic_axis_has_decades_and_leaves_out_what_is_not_positive() {
        let svg = plot(Axis::log("MSE"), vec![[1.0, 1e-3], [2.0, 0.0], [3.0, 1e4]]).to_svg().unwrap();
        assert!(svg.contains(">10⁻³<") && svg.contains(">10⁴<"), "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        assert_eq!(svg.matches("h0").count(), 2);
        assert!(svg.contains("a &lt; b"));
    }

    #[test]
    fn nothing_to_draw_draws_nothing_and_a_constant_draws() {
        assert!(plot(Axis::linear("y"), vec![[f64::NAN, 1.0]]).to_svg().is_none());
        assert!(plot(Axis::log("y"), vec![[1.0, -1.0]]).to_svg().is_none());
        assert!(plot(Axis::linear("y"), vec![[1.0, 0.0]]).to_svg().is_some());
    }

    #[test]
    fn error_bars_widen_the_axis_and_labels_keep_apart() {
        let one = Series::new("one", Style::Points, vec![[1.0, 1.0]]).with_errors(vec![(-4.0, 6.0)]);
        let two = Series::new("two", Style::Line, vec![[0.0, 0.0], [1.0, 1.0]]);
        let plot =
            Plot { alt: String::new(), x: Axis::linear("x"), y: Axis::linear("y"), series: vec![one, two] };
        let svg = plot.to_svg().unwrap();
        assert!(svg.contains(">6<") && svg.contains(">−4<"), "{svg}");
        let height = |label: &str| -> f64 {
            let before = svg.split(&format!(">{label}<")).next().unwrap();
            let y = before.rsplit("y=\"").next().unwrap();
            y.split('"').next().unwrap().parse().unwrap()
        };
        assert!((height("one") - height("two")).abs() >= LINE - 0.11);
    }

    #[test]
    fn a_map_shows_the_sign_and_its_scale() {
        let map = |values: &[Vec<f64>]| surface_map("m", ("x1", (0.0, 1.0)), ("x2", (0.0, 1.0)), values);
        let positive = map(&[vec![0.0, 1.0], vec![2.0, 4.0]]);
        assert!(positive.contains("rgb(0,114,178)") && !positive.contains("rgb(213"), "{positive}");
        assert!(positive.contains(">4.00<") && positive.contains(">2.00<"));
        let signed = map(&[vec![-1.0, 1.0]]);
        assert!(signed.contains("rgb(0,114,178)") && signed.contains("rgb(213,94,0)"));
        assert!(!map(&[vec![0.0]]).contains("NaN") && !map(&[]).contains("NaN"));
    }
}
