//! Chapter 2: identification by the algebraic method.

use std::fmt::Write as _;
use std::ops::Range;

use anyhow::{Context, Result, bail};
use greybox_simulate::rigs::{LinkRun, RotaryFlexibleLink};
use greybox_sparse::Search;
use greybox_sparse::folds::contiguous;
use greybox_sparse::select::{FoldKind, Selector};

use super::duffing::{self, Integrals, Variant, Velocity};
use super::fixture::Fixture;
use super::index::number;
use super::link::{self, Equation};
use super::{Check, Column, Drawing, Entry, Piece, Status, Table};
use greybox_dev::figure::{Axis, Plot, Series, Style, open};

/// Its tables and figures, in order.
pub(crate) fn entries() -> Vec<Entry> {
    vec![
        Entry::new("Figure 2.1", figure_2_1),
        Entry::new("Table 2.1", table_2_1).slow(),
        Entry::new("Figure 2.2", figure_2_2),
        Entry::new("Figure 2.3", figure_2_3),
        Entry::new("Figure 2.4", photograph),
        Entry::new("Table 2.2", table_2_2),
        Entry::new("Table 2.3", table_2_3).slow(),
        Entry::new("Figure 2.5", figure_2_5),
        Entry::new("Figure 2.6", figure_2_6),
        Entry::new("Figure 2.7", figure_2_7),
    ]
}

/// A photograph of a rig.
pub(crate) fn photograph(_: &Fixture) -> Result<Piece> {
    Ok(Piece::new(
        Status::Differs,
        "A photograph of the experiment: there is nothing to compute, and it is not ours to copy.",
    ))
}

/// Rows that each of K contiguous folds of n rows holds out.
fn held_out(n: usize, count: usize) -> Result<Vec<Range<usize>>> {
    // One recording.
    let folds = contiguous(std::slice::from_ref(&(0..n)), count, 0)?;
    let of_fold = |parts: &Vec<usize>| -> Result<Range<usize>> {
        let ranges: Vec<&Range<usize>> = parts.iter().flat_map(|part| &folds.parts[*part]).collect();
        let [one] = ranges.as_slice() else { bail!("a fold of one recording is in {} pieces", ranges.len()) };
        Ok((*one).clone())
    };
    folds.held_out.iter().map(of_fold).collect()
}

/// Figure 2.1: contiguous folds, drawn from the cut of `sparse::folds`, which Algorithm 1 uses.
fn figure_2_1(fixture: &Fixture) -> Result<Piece> {
    let folds = fixture.number("folds of the numerical example", "thesis")? as usize;
    let rows = 30_000;
    let cut = held_out(rows, folds)?;
    let (left, width, height) = (92.0, 612.0, 26.0);
    let mut svg = open(720.0, 62.0 + 32.0 * folds as f64, "Contiguous folds: each validates once");
    for validating in 0..folds {
        let y = 34.0 + 32.0 * validating as f64;
        let _ = write!(svg, "<text x=\"4\" y=\"{:.1}\">model {}</text>", y + 18.0, validating + 1);
        for (k, range) in cut.iter().enumerate() {
            let place = |row: usize| left + width * row as f64 / rows as f64;
            let (from, to) = (place(range.start), place(range.end));
            let (fill, ink, text) = if k == validating {
                ("#d55e00", "#fff", "validation")
            } else {
                ("#dcecf6", "#1d232b", "training")
            };
            let _ = write!(
                svg,
                "<rect x=\"{from:.1}\" y=\"{y}\" width=\"{:.1}\" height=\"{height}\" fill=\"{fill}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{ink}\">{text}</text>",
                to - from - 2.0,
                0.5 * (from + to) - 1.0,
                y + 18.0
            );
        }
    }
    for (k, range) in cut.iter().enumerate() {
        let middle = left + width * 0.5 * (range.start + range.end) as f64 / rows as f64;
        let _ = write!(svg, "<text x=\"{middle:.1}\" y=\"22\" text-anchor=\"middle\">{}</text>", k + 1);
    }
    let _ = write!(
        svg,
        "<text class=\"axis\" x=\"{}\" y=\"{}\" text-anchor=\"middle\">rows in the order of time →</text></svg>",
        left + 0.5 * width,
        54.0 + 32.0 * folds as f64
    );

    // An uneven number of rows, where a careless cut shows.
    let sizes: Vec<usize> = held_out(rows - 1, folds)?.iter().map(Range::len).collect();
    let spread = sizes.iter().max().zip(sizes.iter().min()).map_or(0, |(most, least)| most - least);
    let mut piece = Piece::new(
        Status::Reproduced,
        "Redrawn from the cut into folds. Folds are contiguous: neighbouring rows share most of their data, and \
         random folds leak.",
    );
    piece.figures.push(Drawing {
        caption: "Each of the K models is trained on K − 1 folds and validated on the one left out.".into(),
        svg,
    });
    piece.checks.push(Check::new(
        "rows covered by the folds",
        sizes.iter().sum::<usize>() as f64 / (rows - 1) as f64,
    ));
    piece.checks.push(Check::new("rows between the largest and the smallest fold", spread as f64));
    Ok(piece)
}

/// What the experiment of section 2.2 needs and the thesis does not state.
const ASSUMED: &str =
    "The thesis states neither sample time, length nor initial state; here 1 ms, 60 s, x = 1 at rest.";

/// The variants of Algorithm 1 that are compared over several records.
const VARIANTS: [(&str, Variant); 10] = [
    ("as printed: equation 2.10 over the whole record, observer's velocity", Variant::PRINTED),
    (
        "equation 2.10 over the whole record, true velocity",
        Variant { velocity: Velocity::True, ..Variant::PRINTED },
    ),
    ("windows, observer's velocity", Variant { velocity: Velocity::Observer, ..Variant::WINDOWED }),
    ("windows, LASSO (2.14)", Variant { selector: Selector::Lasso, smallest: 1e-5, ..Variant::WINDOWED }),
    (
        "windows, LASSO and a refit",
        Variant { selector: Selector::LassoRefit, smallest: 1e-5, ..Variant::WINDOWED },
    ),
    ("windows, random folds, λ from 0.0001", Variant { folds: RANDOM, smallest: 1e-4, ..Variant::WINDOWED }),
    ("windows, random folds", Variant { folds: RANDOM, ..Variant::WINDOWED }),
    ("windows, λ from 0.0001", Variant { smallest: 1e-4, ..Variant::WINDOWED }),
    ("windowed: windows, smoothed velocity, thresholds, contiguous folds, λ from 0.01", Variant::WINDOWED),
    ("the same with the true velocity", Variant { velocity: Velocity::True, ..Variant::WINDOWED }),
];

/// Folds of rows drawn at random: what not to do.
const RANDOM: FoldKind = FoldKind::RandomForDemonstration(1);

/// Records for the comparison, with seeds of their own.
const RECORDS: std::ops::Range<u64> = 100..120;

/// Table 2.1: the coefficients of the model of order 3, and how often each variant finds the terms.
fn table_2_1(fixture: &Fixture) -> Result<Piece> {
    let printed = duffing::of_the_page(Variant::PRINTED)?;
    let windowed = duffing::of_the_page(Variant::WINDOWED)?;
    let identified = duffing::identified()?;
    let equation = identified.equations.first().context("no equation")?;
    let third = |search: &Search, term: &str| duffing::coefficient(search, 3, term);
    let fitted = |term: &str| equation.terms.iter().find(|t| t.expression == term);
    let mut piece = Piece::new(
        Status::Reproduced,
        format!(
            "The six terms come out, with errors of the size of the thesis's, when the integrals start anew in every \
             window and the velocity has no lag. With equation 2.10 over the whole record and the observer's velocity \
             (as printed) they do not: the mass is 10 % too large (E6). greybox identify then fits the displacement \
             itself instead of the equation. {ASSUMED}"
        ),
    );
    let names: Vec<String> =
        duffing::terms().into_iter().filter(|term| fixture.row(term).is_some()).collect();
    let column = |title: &str, value: &dyn Fn(&str) -> f64| Column {
        title: title.into(),
        values: names.iter().map(|name| (name.clone(), value(name))).collect(),
    };
    piece.columns.push(column("as printed", &|term| third(&printed, term)));
    piece.columns.push(column("windowed", &|term| third(&windowed, term)));
    let mut own = column("greybox identify", &|term| fitted(term).map_or(0.0, |t| t.value));
    // A term outside the thesis's table must not go unseen: `judge` refuses its row.
    let unknown = equation.terms.iter().filter(|t| fixture.row(&t.expression).is_none());
    own.values.extend(unknown.map(|t| (t.expression.clone(), t.value)));
    piece.columns.push(own);

    let mut rows = Vec::new();
    for (term, truth) in duffing::TRUTH {
        let off = |value: f64| 100.0 * (value / truth - 1.0);
        let (as_printed, ours) = (off(third(&printed, term)), off(third(&windowed, term)));
        let found = fitted(term).map_or(-100.0, |t| off(t.value));
        let interval = fitted(term).and_then(|t| t.ci95).map_or_else(String::new, |(low, high)| {
            format!("{} … {}", percent(off(low)), percent(off(high)))
        });
        let cells = [off(fixture.number(term, "thesis")?), as_printed, ours, found].map(percent);
        rows.push([vec![term.to_owned()], cells.to_vec(), vec![interval]].concat());
        piece.checks.push(Check::new(format!("{term}, windowed, % off"), ours.abs()));
        piece.checks.push(Check::new(format!("{term}, greybox identify, % off"), found.abs()));
    }
    piece.checks.push(Check::new("x'', as printed, % off", 100.0 * (third(&printed, "x''") / 2.0 - 1.0)));
    let headings =
        ["error in %", "thesis", "as printed", "windowed", "greybox identify", "its 95 % interval"];
    let caption = "Errors of the coefficients in % of the true ones".into();
    piece.tables.push(Table { caption, headings: headings.map(String::from).into(), rows });
    compare(&mut piece)?;
    Ok(piece)
}

/// How often every variant finds the terms, and how well their coefficients.
fn compare(piece: &mut Piece) -> Result<()> {
    let records = RECORDS.map(duffing::Record::new).collect::<Result<Vec<_>>>()?;
    let mut rows = Vec::new();
    for (name, variant) in VARIANTS {
        let tally = duffing::tally(&records, variant)?;
        let counts = [tally.order_three, tally.exact].map(|count| format!("{count} of {}", tally.records));
        let medians = tally.medians.map(percent).to_vec();
        rows.push([vec![name.to_owned()], counts.to_vec(), medians].concat());
        let short = name.split(':').next().unwrap_or(name);
        piece.checks.push(Check::new(format!("exact terms, {short}"), tally.exact as f64));
        if variant == Variant::WINDOWED {
            piece.checks.push(Check::new("least AIC at order 3, windowed", tally.order_three as f64));
            for ((term, _), median) in duffing::TRUTH.iter().zip(tally.medians) {
                piece.checks.push(Check::new(format!("median {term}, windowed, % off"), median));
            }
        }
    }
    let mut headings = vec!["Algorithm 1".to_owned(), "order 3".into(), "exact terms".into()];
    headings.extend(duffing::TRUTH.map(|(term, _)| format!("{term}, %")));
    let caption = format!(
        "What decides, over {} records with noise of their own: how often AIC is least at order 3, how often exactly \
         the six terms are found, and the median error of their coefficients in % (a missing term is 100 % off)",
        RECORDS.count()
    );
    piece.tables.push(Table { caption, headings, rows });
    Ok(())
}

/// A percentage to two decimals.
fn percent(value: f64) -> String {
    format!("{value:.2}").replace('-', "−")
}

/// (order, AIC) of every order.
fn aic(search: &Search) -> Vec<[f64; 2]> {
    search.orders.iter().map(|model| [model.order as f64, model.aic]).collect()
}

/// (λ, MSE_cv) of an order.
fn cross_validation(search: &Search, order: usize) -> Result<Vec<[f64; 2]>> {
    let model = search.orders.get(order - 1).with_context(|| format!("no order {order}"))?;
    Ok(model.grid.iter().zip(&model.cv_mean).map(|(lambda, error)| [*lambda, *error]).collect())
}

/// MSE_cv at the smallest and at the largest λ over its minimum: both above one when the minimum lies inside.
fn rise(curve: &[[f64; 2]]) -> [f64; 2] {
    let least = curve.iter().map(|p| p[1]).fold(f64::INFINITY, f64::min);
    [curve.first(), curve.last()].map(|end| end.map_or(f64::NAN, |p| p[1] / least))
}

/// Adds a plot to a piece; its caption describes it as well.
pub(crate) fn draw(piece: &mut Piece, caption: &str, axes: (Axis, Axis), series: Vec<Series>) -> Result<()> {
    let (x, y) = axes;
    let plot = Plot { alt: caption.into(), x, y, series };
    let svg = plot.to_svg().with_context(|| format!("{caption}: nothing to draw"))?;
    piece.figures.push(Drawing { caption: caption.into(), svg });
    Ok(())
}

fn aic_axes() -> (Axis, Axis) {
    (Axis::whole("order of the polynomial"), Axis::linear("AIC on the test rows"))
}

fn lambda_axes() -> (Axis, Axis) {
    (Axis::log("λ"), Axis::log("MSE_cv"))
}

/// Figure 2.2: AIC by order.
fn figure_2_2(_: &Fixture) -> Result<Piece> {
    let printed = duffing::of_the_page(Variant::PRINTED)?;
    let windowed = duffing::of_the_page(Variant::WINDOWED)?;
    let mut piece = Piece::new(
        Status::Reproduced,
        format!(
            "With windows and a velocity without lag, AIC falls until order 3 and not further. As printed it does not: \
             with the wrong velocity no order has the right terms, and the least AIC lies anywhere. Values depend on the \
             rows and their scale; the thesis states none. {ASSUMED}"
        ),
    );
    let curve = |search: &Search| vec![Series::new("", Style::Joined, aic(search))];
    draw(&mut piece, "Windowed: AIC is least at order 3.", aic_axes(), curve(&windowed))?;
    draw(
        &mut piece,
        "As printed: equation 2.10 over the whole record, observer's velocity.",
        aic_axes(),
        curve(&printed),
    )?;
    let headings = ["order", "terms, windowed", "AIC, windowed", "terms, as printed", "AIC, as printed"];
    let rows = windowed.orders.iter().zip(&printed.orders).map(|(ours, literal)| {
        let size = |model: &greybox_sparse::OrderModel| model.support.len().to_string();
        vec![ours.order.to_string(), size(ours), number(ours.aic), size(literal), number(literal.aic)]
    });
    piece.tables.push(Table {
        caption: "AIC of the model of every order".into(),
        headings: headings.map(String::from).into(),
        rows: rows.collect(),
    });
    piece.checks.push(Check::new("order of the minimum, windowed", windowed.model().order as f64));
    let fall = windowed.orders[1].aic - windowed.orders[2].aic;
    piece.checks.push(Check::new("fall of AIC from order 2 to 3, windowed", fall));
    piece.checks.push(Check::new("order of the minimum, as printed", printed.model().order as f64));
    Ok(piece)
}

/// Figure 2.3: the cross-validation error over λ at order 3.
fn figure_2_3(_: &Fixture) -> Result<Piece> {
    // The range of λ is wider than the one searched, to show where the minimum lies.
    let curve =
        |variant: Variant| cross_validation(&duffing::of_the_page(Variant { smallest: 1e-4, ..variant })?, 3);
    let windowed = curve(Variant::WINDOWED)?;
    let random = curve(Variant { folds: RANDOM, ..Variant::WINDOWED })?;
    let printed = curve(Variant::PRINTED)?;
    let mut piece = Piece::new(
        Status::Reproduced,
        format!(
            "MSE_cv has a minimum inside the range of λ, as in the thesis. With folds drawn at random a held-out row is \
             all but known from its neighbours: the error keeps falling towards small λ, and terms that are not there \
             stay in. {ASSUMED}"
        ),
    );
    let curves = vec![
        Series::new("contiguous", Style::Joined, windowed.clone()),
        Series::new("random", Style::Joined, random),
    ];
    draw(
        &mut piece,
        "Windowed, with contiguous folds (Figure 2.1) and with folds drawn at random.",
        lambda_axes(),
        curves,
    )?;
    draw(
        &mut piece,
        "As printed: equation 2.10 over the whole record, observer's velocity.",
        lambda_axes(),
        vec![Series::new("", Style::Joined, printed)],
    )?;
    let [left, right] = rise(&windowed);
    piece.checks.push(Check::new("MSE_cv at the smallest λ over the minimum, windowed", left));
    piece.checks.push(Check::new("MSE_cv at the largest λ over the minimum, windowed", right));
    Ok(piece)
}

/// Constants of the rotary flexible beam (equations 2.20 and 2.21).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Beam {
    jl: f64,
    jeq: f64,
    beq: f64,
    ks: f64,
    kg: f64,
    kt: f64,
    km: f64,
    rm: f64,
    eta: f64,
}

impl Beam {
    /// From a column of Table 2.2 or 3.3: as printed ("thesis") or as the results need them ("truth").
    pub(crate) fn read(fixture: &Fixture, column: &str) -> Result<Self> {
        let get = |row: &str| fixture.number(row, column);
        Ok(Self {
            jl: get("Jl")?,
            jeq: get("Jeq")?,
            beq: get("Beq")?,
            ks: get("ks")?,
            kg: get("kg")?,
            kt: get("kt")?,
            km: get("km")?,
            rm: get("Rm")?,
            eta: get("eta_g")? * get("eta_m")?,
        })
    }

    /// The consistent set (E8, E9).
    fn consistent() -> Self {
        let (jl, jeq, beq, ks) = (0.0038, 2.084e-3, 0.025, 1.3);
        Self { jl, jeq, beq, ks, kg: 70.0, kt: 7.68e-3, km: 7.68e-3, rm: 2.6, eta: 0.9 * 0.69 }
    }

    /// Volts per newton metre: Rm/(ηg kg ηm kt).
    pub(crate) fn volts_per_torque(&self) -> f64 {
        self.rm / (self.eta * self.kg * self.kt)
    }

    /// C Jeq, the coefficient of θ'' (and, negative, of α'').
    fn inertia(&self) -> f64 {
        self.volts_per_torque() * self.jeq
    }

    /// C (Beq + ηg kg² km ηm kt / Rm), the coefficient of θ'.
    fn damping(&self) -> f64 {
        self.volts_per_torque() * (self.beq + self.eta * self.kg * self.kg * self.km * self.kt / self.rm)
    }

    /// −C ks, the coefficient of α in the θ-equation.
    fn stiffness(&self) -> f64 {
        -self.volts_per_torque() * self.ks
    }

    /// (Jl + Jeq)/Jl, by which the α-equation's coefficient of α is larger.
    pub(crate) fn inertia_ratio(&self) -> f64 {
        (self.jl + self.jeq) / self.jl
    }

    /// The spring's factor in the α-equation, ks (Jl + Jeq)/Jl.
    pub(crate) fn joint_stiffness(&self) -> f64 {
        self.ks * self.inertia_ratio()
    }
}

/// Something that follows from the constants.
type Quantity = fn(&Beam) -> f64;

/// What the constants, as printed and consistent, make of the thesis's other numbers: the table, and the
/// largest relative gap of the consistent set.
fn consistency(printed: &Beam, consistent: &Beam) -> (Table, f64) {
    let quantities: [(&str, Quantity, f64); 4] = [
        ("θ'' of Table 2.3: C·Jeq", Beam::inertia, 0.016231),
        ("θ' of Table 2.3: C·(Beq + ηg·kg²·km·ηm·kt/Rm)", Beam::damping, 0.7323),
        ("α in the θ-equation of Table 2.3: −C·ks", Beam::stiffness, -10.124),
        ("ratio of both α coefficients: (Jl + Jeq)/Jl", Beam::inertia_ratio, 15.672 / 10.124),
    ];
    let mut worst: f64 = 0.0;
    let mut rows = Vec::new();
    for (name, value, thesis) in quantities {
        worst = worst.max((value(consistent) / thesis - 1.0).abs());
        rows.push(vec![name.into(), number(thesis), number(value(printed)), number(value(consistent))]);
    }
    // E8: were Jl and Jeq merely swapped?
    let swapped = Beam { jl: printed.jeq, jeq: printed.jl, ..*printed };
    for (name, value) in [
        ("with Jl and Jeq swapped: C·Jeq", swapped.inertia()),
        ("with Jl and Jeq swapped: −C·ks·(Jl + Jeq)/Jl", swapped.stiffness() * swapped.inertia_ratio()),
    ] {
        rows.push(vec![
            name.into(),
            if name.ends_with("Jeq") { "0.016231" } else { "−15.672" }.into(),
            number(value),
            String::new(),
        ]);
    }
    let headings = ["", "thesis", "from the constants as printed", "from the consistent set"];
    let caption =
        "What the constants give, beside the thesis's own results; C = Rm/(ηg·kg·ηm·kt) V/(N m)".into();
    (Table { caption, headings: headings.map(String::from).into(), rows }, worst)
}

/// Table 2.2: constants, and what contradicts them (E7, E8, E9).
fn table_2_2(fixture: &Fixture) -> Result<Piece> {
    let (printed, consistent) = (Beam::read(fixture, "thesis")?, Beam::read(fixture, "truth")?);
    let mut piece = Piece::new(
        Status::Constants,
        "Data-sheet values. Two of them contradict the thesis's own Table 2.3; the last column is the set that agrees.",
    );
    let (table, worst) = consistency(&printed, &consistent);
    piece.tables.push(table);
    piece.checks.push(Check::new("C in V/(N m)", printed.volts_per_torque()));
    piece.checks.push(Check::new("largest gap of the consistent set to Table 2.3", worst));
    piece.checks.push(Check::new("C*Jeq as printed, against 0.016231", printed.inertia() / 0.016231));
    piece.checks.push(Check::new("C*Jeq with Jl and Jeq swapped", printed.volts_per_torque() * printed.jl));
    Ok(piece)
}

/// Why a rig takes the place of the link.
const LINK: &str = "The recordings are not public. A virtual link with the coefficients that the thesis identified takes \
                    the real one's place, with kp = √10 (E16), Coulomb friction that sticks, and noise of 1 mrad on \
                    both angles. A dither of six sines of 0.12 V is added to the voltage: without it the loop \
                    V = kp (θ_d − θ) ties the voltage to the angle, and the terms cannot be told apart.";

/// Table 2.3: the column 'Quanser' follows from the constants; the identified one is found again on the rig.
fn table_2_3(fixture: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{LINK} So the thesis's identified column is the truth here. The column Quanser follows from equation 2.21 \
             and the consistent constants of Table 2.2. greybox identify got the first {} s of the record of {} s.",
            link::IDENTIFIED_SECONDS,
            link::SECONDS
        ),
    );
    let nominal = quanser();
    let mut worst: f64 = 0.0;
    for (row, value) in &nominal {
        worst = worst.max((value / fixture.number(row, "nominal")? - 1.0).abs());
    }
    piece.columns.push(Column { title: "Quanser, computed".into(), values: nominal });
    piece.checks.push(Check::new("largest gap to the column Quanser", worst));

    let (found, known) = (link::of_the_page()?, link::with_velocities(Velocity::True)?);
    let identified = link::identified()?;
    let (mut by_windows, mut by_identify, mut rows) = (Vec::new(), Vec::new(), Vec::new());
    let (mut inside, mut all) = (0usize, 0usize);
    for (k, equation) in Equation::BOTH.into_iter().enumerate() {
        let own = identified.equations.get(k).context("an equation is missing")?;
        let models = [found[k].terms(None), known[k].terms(None), link::terms_of(own)];
        let name = |term: &str| format!("{}: {term}", equation.number());
        by_windows.extend(models[0].iter().map(|(term, value)| (name(term), *value)));
        by_identify.extend(models[2].iter().map(|(term, value)| (name(term), *value)));
        let mut worst = [0.0_f64; 3];
        for (term, truth) in equation.truth() {
            let off = |value: f64| 100.0 * (value / truth - 1.0);
            let errors = [0, 1, 2].map(|m: usize| {
                let found = models[m].iter().find(|(name, _)| name == term);
                off(found.map_or(0.0, |t| t.1))
            });
            for (worst, error) in worst.iter_mut().zip(errors) {
                *worst = worst.max(error.abs());
            }
            let interval = own.terms.iter().find(|t| t.expression == term).and_then(|t| t.ci95);
            all += 1;
            inside += usize::from(interval.is_some_and(|(low, high)| low <= truth && truth <= high));
            let interval = interval.map_or_else(String::new, |(a, b)| {
                let (a, b) = (off(a).min(off(b)), off(a).max(off(b)));
                format!("{} … {}", percent(a), percent(b))
            });
            rows.push(
                [vec![name(term), number(truth)], errors.map(percent).to_vec(), vec![interval]].concat(),
            );
        }
        let symbol = equation.symbol();
        for ((title, terms), worst) in
            ["windowed", "windowed, true velocities", "greybox identify"].iter().zip(&models).zip(worst)
        {
            let known = |term: &str| equation.truth().iter().any(|(name, _)| *name == term);
            let extra = terms.iter().filter(|(term, _)| !known(term)).count();
            piece.checks.push(Check::new(format!("largest error, {symbol}, {title}, %"), worst));
            piece.checks.push(Check::new(format!("terms too many, {symbol}, {title}"), extra as f64));
        }
    }
    let share = 100.0 * inside as f64 / all as f64;
    piece.checks.push(Check::new("intervals of greybox identify that hold the truth, %", share));
    // A term that was not found is zero.
    for row in fixture.rows.iter().filter_map(|row| row.get("name")?.as_str()) {
        for column in [&mut by_windows, &mut by_identify] {
            if column.iter().all(|(name, _)| name != row) {
                column.push((row.to_owned(), 0.0));
            }
        }
    }
    piece.columns.push(Column { title: "virtual rig, windowed".into(), values: by_windows });
    piece.columns.push(Column { title: "virtual rig, greybox identify".into(), values: by_identify });
    let headings = [
        "error in %",
        "truth on the rig",
        "windowed",
        "windowed, true velocities",
        "greybox identify",
        "its 95 % interval",
    ];
    let caption = format!(
        "Errors of the coefficients found on the virtual rig, in % of its own; {inside} of {all} intervals hold the truth. \
         The sign of a smoothed velocity is wrong \
         while the hub sticks: with the true velocities the largest windowed errors halve. The noise of the angles stays \
         in the regressors and, fed back, in the voltage."
    );
    piece.tables.push(Table { caption, headings: headings.map(String::from).into(), rows });
    piece.tables.push(what_the_link_needs(&mut piece.checks)?);
    Ok(piece)
}

/// The coefficients that equation 2.21 has with the consistent constants.
fn quanser() -> Vec<(String, f64)> {
    let beam = Beam::consistent();
    let values = [
        ("2.24: theta''", beam.inertia()),
        ("2.24: theta'", beam.damping()),
        ("2.24: alpha", beam.stiffness()),
        ("2.25: alpha''", -beam.inertia()),
        ("2.25: theta'", beam.damping()),
        ("2.25: alpha", beam.stiffness() * beam.inertia_ratio()),
    ];
    values.map(|(name, value)| (name.to_owned(), value)).into()
}

/// Records of the link for the comparison, with seeds of their own.
const LINK_RECORDS: std::ops::Range<u64> = 100..110;

/// How often the terms of the link are found, with the dither and without, and with the observer.
fn what_the_link_needs(checks: &mut Vec<Check>) -> Result<Table> {
    let variants = [
        ("windowed, with the dither", true, Velocity::Smoothed, Integrals::Windows),
        ("windowed, no dither", false, Velocity::Smoothed, Integrals::Windows),
        (
            "as printed: whole record, observer's velocities, no dither",
            false,
            Velocity::Observer,
            Integrals::WholeRecord,
        ),
    ];
    let mut rows = Vec::new();
    for (name, dithered, velocity, integrals) in variants {
        let mut counts = [[0usize; 2]; 2];
        for seed in LINK_RECORDS {
            let record = link::Record::new(seed, dithered)?;
            for (count, equation) in counts.iter_mut().zip(Equation::BOTH) {
                let found = link::search(&record, equation, velocity, integrals)?;
                count[0] += usize::from(found.search.model().order == 3);
                count[1] += usize::from(found.is_exact(equation, None));
            }
        }
        let cell = |count: usize| format!("{count} of {}", LINK_RECORDS.count());
        rows.push([vec![name.to_owned()], counts.as_flattened().iter().map(|c| cell(*c)).collect()].concat());
        let short = name.split(':').next().unwrap_or(name);
        let exact: usize = counts.iter().map(|count| count[1]).sum();
        checks.push(Check::new(format!("exact equations, {short}"), exact as f64));
    }
    let headings = ["Algorithm 1", "θ: order 3", "θ: exact terms", "α: order 3", "α: exact terms"];
    let caption =
        format!("What decides on the link, over {} records with noise of their own", LINK_RECORDS.count());
    Ok(Table { caption, headings: headings.map(String::from).into(), rows })
}

/// Figure 2.5: AIC by order on the virtual rig.
fn figure_2_5(_: &Fixture) -> Result<Piece> {
    let mut piece =
        Piece::new(Status::VirtualRig, format!("{LINK} Values of AIC depend on the rows and their scale."));
    let found = link::of_the_page()?;
    let curves = Equation::BOTH.iter().zip(found);
    let series =
        curves.map(|(equation, found)| Series::new(equation.symbol(), Style::Joined, aic(&found.search)));
    draw(&mut piece, "Windowed: AIC of both equations.", aic_axes(), series.collect())?;
    for (equation, found) in Equation::BOTH.iter().zip(found) {
        let symbol = equation.symbol();
        let orders = &found.search.orders;
        piece
            .checks
            .push(Check::new(format!("order of the minimum, {symbol}"), found.search.model().order as f64));
        piece.checks.push(Check::new(
            format!("fall of AIC from order 2 to 3, {symbol}"),
            orders[1].aic - orders[2].aic,
        ));
    }
    Ok(piece)
}

/// Figure 2.6: the cross-validation error over λ at order 3 on the virtual rig.
fn figure_2_6(_: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{LINK} λ is here relative to a term's share of the voltage, since the coefficients span three decades. On \
             the rig the curves are flat towards small λ and rise where a true term is lost; the minimum lies in between, \
             but only 3 % below the flat part. The sparsest model within one standard \
             error of the least MSE_cv is taken."
        ),
    );
    let mut series = Vec::new();
    for (equation, found) in Equation::BOTH.iter().zip(link::of_the_page()?) {
        let curve = cross_validation(&found.search, 3)?;
        let symbol = equation.symbol();
        let [left, right] = rise(&curve);
        piece.checks.push(Check::new(format!("MSE_cv at the smallest λ over the minimum, {symbol}"), left));
        piece.checks.push(Check::new(format!("MSE_cv at the largest λ over the minimum, {symbol}"), right));
        series.push(Series::new(symbol, Style::Joined, curve));
    }
    draw(
        &mut piece,
        "Windowed: cross-validation error of both equations at order 3.",
        lambda_axes(),
        series,
    )?;
    Ok(piece)
}

/// Figure 2.7: the closed loop of the rig, of what was identified, and of the maker's linear model.
fn figure_2_7(_: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!("{LINK} Here the loop runs without noise and dither, on the rig and on both models."),
    );
    let seconds = 6.0;
    let [theta, alpha] = link::of_the_page()?;
    let identified = link::rig(&theta.terms(None), &alpha.terms(None))?;
    let runs = [
        ("Quanser", link::closed_loop(&RotaryFlexibleLink::QUANSER, seconds)?),
        ("rig", link::closed_loop(&RotaryFlexibleLink::IDENTIFIED, seconds)?),
        ("identified", link::closed_loop(&identified, seconds)?),
    ];
    for (angle, symbol) in [(0, "θ"), (1, "α")] {
        let column =
            |k: usize| -> Vec<f64> { runs[k].1.states.iter().map(|s| s[angle].to_degrees()).collect() };
        let mut series = Vec::new();
        for (k, (name, _)) in runs.iter().enumerate() {
            let values = column(k);
            if *name != "rig" {
                let off = 100.0 * relative_rms(&values, &column(1));
                piece.checks.push(Check::new(format!("{symbol}, {name}, relative rms error in %"), off));
            }
            // The curve on top must not hide the one below.
            let style = if *name == "identified" { Style::Dashed } else { Style::Line };
            let points = values.iter().enumerate().step_by(10).map(|(k, v)| [k as f64 * link::STEP, *v]);
            series.push(Series::new(*name, style, points.collect()));
        }
        let axes = (Axis::linear("time in s"), Axis::linear(format!("{symbol} in degrees")));
        draw(&mut piece, &format!("{symbol} on the square wave of ±30°, 0.66 Hz."), axes, series)?;
    }
    let voltage = |(name, run): &(&str, LinkRun)| {
        let style = if *name == "identified" { Style::Dashed } else { Style::Line };
        let points = run.voltages.iter().enumerate().step_by(10).map(|(k, v)| [k as f64 * link::STEP, *v]);
        Series::new(*name, style, points.collect())
    };
    let axes = (Axis::linear("time in s"), Axis::linear("input voltage in V"));
    draw(&mut piece, "The voltage that the controller asks for.", axes, runs.iter().map(voltage).collect())?;
    let largest = |run: &LinkRun| run.voltages.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
    piece.checks.push(Check::new("largest voltage of the rig", largest(&runs[1].1)));
    let off = 100.0 * relative_rms(&runs[2].1.voltages, &runs[1].1.voltages);
    piece.checks.push(Check::new("voltage, identified, relative rms error in %", off));
    Ok(piece)
}

/// RMS(estimate − truth) / RMS(truth).
pub fn relative_rms(estimate: &[f64], truth: &[f64]) -> f64 {
    let wrong: f64 = estimate.iter().zip(truth).map(|(e, t)| (e - t) * (e - t)).sum();
    let size: f64 = truth.iter().map(|t| t * t).sum();
    (wrong / size).sqrt()
}

#[cfg(test)]
mod tests {
    use greybox_simulate::rigs::RotaryFlexibleJoint;

    use super::*;

    #[test]
    fn the_constants_in_use_are_those_of_the_tables() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        let table = |id: &str| Fixture::read(&folder, id).unwrap();
        assert_eq!(Beam::read(&table("Table 2.2"), "truth").unwrap(), Beam::consistent());
        let joint = Beam::read(&table("Table 3.3"), "truth").unwrap();
        assert_eq!(joint, Beam { beq: 0.015, ..Beam::consistent() });
        let rig = RotaryFlexibleJoint::LINEAR;
        assert_eq!([rig.link_inertia, rig.base_damping, rig.stiffness], [joint.jl, joint.beq, joint.ks]);
        assert!((rig.torque_per_volt * joint.volts_per_torque() - 1.0).abs() < 1e-12);
        assert!((rig.back_emf * joint.volts_per_torque() + joint.kg * joint.km).abs() < 1e-12);
    }

    #[test]
    fn the_common_factor_is_that_of_erratum_e7() {
        assert!((Beam::consistent().volts_per_torque() - 7.78794).abs() < 5e-6);
    }
}
