//! The tables and figures of chapter 3 that Algorithm 2 makes: on the delayed oscillator and on the virtual joint.

use anyhow::{Context, Result, bail};
use greybox_delay::taylor::{Model, Search};
use greybox_identify::Identification;

use super::chapter2::draw;
use super::delayed::{self, Variant, Which};
use super::delayed_joint;
use super::duffing::Velocity;
use super::fixture::Fixture;
use super::index::number;
use super::link::Equation;
use super::{Check, Column, Piece, Status, Table, median};
use greybox_dev::figure::{Axis, Series, Style};

/// Pairs of records behind the comparison of delays, with seeds of their own.
const RECORDS: std::ops::Range<u64> = 100..110;
/// Of these, those that `greybox identify` gets.
const IDENTIFIED: std::ops::Range<u64> = 100..103;

/// The selected delay of both systems, s.
const DELAY: f64 = 0.2;

/// Table 3.1: the coefficients of order 3, what delay they mean, and what their standard deviations are worth.
pub(crate) fn table_3_1(fixture: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::Reproduced,
        "Equation 3.10 over 5 s as printed, and windows of 1 s over 10 s, both with the true velocity: with the thesis's \
         observer the terms are lost. Length and velocity are not stated. Both find the terms. As printed, a few \
         replicates of the bootstrap lose some in this record and spoil the mean: the standard deviations show it. The \
         delay from the cube root of the smallest coefficient is short, in the thesis as here: an expansion to third \
         order does not hold for the fast motion that shows the delay. With a smoothed velocity it scatters around the \
         truth. Without the expansion it comes out.",
    );
    for (title, search) in ["as printed", "windowed"].into_iter().zip(delayed::of_the_page()?) {
        let model = search.models.get(2).context("no model of order 3")?;
        let (mut values, mut deviations) = (Vec::new(), Vec::new());
        for term in delayed::terms(3).into_iter().filter(|term| fixture.row(term).is_some()) {
            let (value, deviation) = delayed::estimate(model, &term);
            values.push((term.clone(), value));
            deviations.push((term, deviation));
        }
        piece.columns.push(Column { title: title.into(), values });
        piece.columns.push(Column { title: format!("{title}, standard deviation"), values: deviations });

        let off = |(term, truth): (&str, f64)| 100.0 * (delayed::estimate(model, term).0 / truth - 1.0);
        let [jerk, others @ ..] = delayed::truth();
        let worst = others.into_iter().map(|term| off(term).abs()).fold(0.0, f64::max);
        piece.checks.push(Check::new(format!("x''', {title}, % off"), off(jerk)));
        piece.checks.push(Check::new(format!("largest error of the others, {title}, %"), worst));
        piece.checks.push(Check::new(format!("terms, {title}"), model.active().len() as f64));
    }
    let identified = IDENTIFIED.map(delayed::identified).collect::<Result<Vec<_>>>()?;
    let models = algorithm_2(&mut piece)?;
    delays(&mut piece, &models, &identified)?;
    coverage(&mut piece, &models, &identified);
    Ok(piece)
}

/// A variant of Algorithm 2 with its models of order 3.
struct Models {
    name: &'static str,
    /// Its name among the bounds.
    short: &'static str,
    models: Vec<Model>,
}

/// Algorithm 2 on all pairs of records.
fn algorithm_2(piece: &mut Piece) -> Result<Vec<Models>> {
    let observed = Variant { velocity: Velocity::Observer, ..Variant::PRINTED };
    let smoothed = Variant { velocity: Velocity::Smoothed, ..Variant::WINDOWED };
    let mut all = Vec::new();
    for (name, short, variant) in [
        ("Algorithm 2 as printed, observer's velocity, from x'''", "as printed, observer", observed),
        ("Algorithm 2 as printed, true velocity, from x'''", "as printed", Variant::PRINTED),
        ("Algorithm 2 windowed, smoothed velocity, from x'''", "windowed, smoothed", smoothed),
        ("Algorithm 2 windowed, true velocity, from x'''", "windowed", Variant::WINDOWED),
    ] {
        let mut models = Vec::new();
        for seed in RECORDS {
            models.push(delayed::search(variant, 3, seed)?.models.pop().context("no model of order 3")?);
        }
        let exact = models.iter().filter(|model| delayed::is_exact(model)).count();
        piece.checks.push(Check::new(format!("exact terms, {short}"), exact as f64));
        all.push(Models { name, short, models });
    }
    Ok(all)
}

/// The delay by every method.
fn delays(piece: &mut Piece, models: &[Models], identified: &[Identification]) -> Result<()> {
    let mut lines: Vec<(&str, &str, Vec<f64>, String)> = Vec::new();
    for Models { name, short, models } in models {
        let exact = models.iter().filter(|model| delayed::is_exact(model)).count();
        let delays = models.iter().map(|model| delayed::delay_from_jerk(model.coefficients[0])).collect();
        lines.push((name, short, delays, format!("exact terms in {exact} of {}", models.len())));
    }
    for (name, short, velocity) in [
        ("x(t − τ) in the regression, smoothed velocity", "exact, smoothed", Velocity::Smoothed),
        ("x(t − τ) in the regression, true velocity", "exact", Velocity::True),
    ] {
        let delay = |seed| Ok(delayed::exact_delay(velocity, seed)?.delay);
        let found = RECORDS.map(delay).collect::<Result<Vec<f64>>>()?;
        lines.push((name, short, found, "terms and kp known, both records of 20 s".into()));
    }
    let found = identified.iter().filter_map(|i| i.delays.first()).map(|delay| delay.value).collect();
    let note = format!("terms unknown, kp known, both records of 20 s, {} pairs", identified.len());
    lines.push(("greybox identify", "greybox identify", found, note));

    let mut rows = vec![vec!["thesis, from x'''".to_owned(), "0.1656".into(), String::new(), String::new()]];
    for (name, short, delays, note) in lines {
        let ends = delays.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), d| (l.min(*d), h.max(*d)));
        let worst = (ends.0 / DELAY - 1.0).abs().max((ends.1 / DELAY - 1.0).abs());
        let middle = median(delays);
        let range = format!("{} … {}", number(ends.0), number(ends.1));
        rows.push(vec![name.to_owned(), number(middle), range, note]);
        // With the observer's velocity the delay is anywhere, and no bound would say anything.
        if !short.ends_with("observer") {
            piece.checks.push(Check::new(format!("median delay, {short}, s"), middle));
            let name = format!("largest error of the delay, {short}, %");
            piece.checks.push(Check::new(name, 100.0 * worst));
        }
    }
    let headings = ["", "delay in s, median", "from … to", "remark"].map(String::from).into();
    let caption =
        format!("The delay of {DELAY} s by every method, over {} pairs of records", RECORDS.count());
    piece.tables.push(Table { caption, headings, rows });
    Ok(())
}

/// How many intervals hold the truth, and of how many.
#[derive(Debug, Clone, Copy, Default)]
struct Held {
    inside: usize,
    of: usize,
}

impl Held {
    fn add(&mut self, inside: bool) {
        self.inside += usize::from(inside);
        self.of += 1;
    }

    fn percent(self) -> f64 {
        100.0 * self.inside as f64 / self.of as f64
    }
}

/// The bootstrap's standard deviations beside those from record to record, and the intervals of an identification.
fn coverage(piece: &mut Piece, models: &[Models], identified: &[Identification]) {
    let mut rows: Vec<Vec<String>> = delayed::truth().map(|(term, _)| vec![term.to_owned()]).into();
    let mut headings = vec![String::new()];
    let mut sentences = Vec::new();
    for Models { short, models, .. } in
        models.iter().filter(|m| ["as printed", "windowed"].contains(&m.short))
    {
        let mut total = Held::default();
        for (row, (term, truth)) in rows.iter_mut().zip(delayed::truth()) {
            let estimates: Vec<(f64, f64)> = models.iter().map(|m| delayed::estimate(m, term)).collect();
            let mut held = Held::default();
            estimates.iter().for_each(|(value, std)| held.add((value - truth).abs() <= 1.96 * std));
            let claimed = median(estimates.iter().map(|e| e.1).collect());
            let spread = standard_deviation(&estimates.iter().map(|e| e.0).collect::<Vec<f64>>());
            row.extend([number(claimed), number(spread), format!("{} of {}", held.inside, held.of)]);
            total = Held { inside: total.inside + held.inside, of: total.of + held.of };
        }
        headings.extend([
            format!("{short}: bootstrap"),
            "between records".into(),
            "truth inside ±1.96".into(),
        ]);
        let name = format!("bootstrap intervals that hold the truth, {short}, %");
        piece.checks.push(Check::new(name, total.percent()));
        sentences.push(format!("{:.0} % ({short})", total.percent()));
    }
    let own = held_by(identified);
    piece.checks.push(Check::new("intervals of greybox identify that hold the truth, %", own.percent()));
    let caption = format!(
        "Standard deviations of the coefficients: by the bootstrap of single rows, as in the thesis, and from record to \
         record. As printed, neighbouring rows share their past, and the bootstrap sees a fraction of the spread. In \
         windows it sees the spread, but not what the truncated expansion puts into x''', x'' and x'. Its intervals \
         hold the truth in {} of all cases instead of 95 %; those of greybox identify hold it in {} of {}.",
        sentences.join(" and "),
        own.inside,
        own.of
    );
    piece.tables.push(Table { caption, headings, rows });
}

fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1.0)).sqrt()
}

/// The 95 % intervals of the true terms and of the delay.
fn held_by(identified: &[Identification]) -> Held {
    let truth = [("x''", 1.0), ("x'", 1.0), ("x", 6.0), ("x^3", 2.0), ("x^2*x'", 1.0), ("x'^3", 1.0)];
    let mut held = Held::default();
    for found in identified {
        for (name, value) in truth {
            // A term that is missing does not hold the truth.
            let term = found.equations.first().and_then(|e| e.terms.iter().find(|t| t.expression == name));
            held.add(term.and_then(|t| t.ci95).is_some_and(|(low, high)| low <= value && value <= high));
        }
        let delay = found.delays.first().and_then(|delay| delay.ci95);
        held.add(delay.is_some_and(|(low, high)| low <= DELAY && DELAY <= high));
    }
    held
}

/// (order, MSE on the test rows).
fn test_errors(search: &Search) -> Vec<[f64; 2]> {
    search.models.iter().map(|model| [model.order as f64, model.test_error]).collect()
}

/// The chosen order.
fn chosen(search: &Search) -> f64 {
    search.model().map_or(f64::NAN, |model| model.order as f64)
}

/// Figure 3.1: the test error by order.
pub(crate) fn figure_3_1(_: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::Reproduced,
        "The error falls by orders of magnitude at order 3 and not further. As printed it rises from order 5 on, as in \
         the thesis; orders 3 and 4 are alike, and which of them is least depends on the noise.",
    );
    let captions = [
        "As printed: equation 3.10 over the whole record of 5 s, true velocity.",
        "Windowed: windows of 1 s over 10 s, true velocity.",
    ];
    for ((title, search), caption) in
        ["as printed", "windowed"].into_iter().zip(delayed::of_the_page()?).zip(captions)
    {
        let error = |order: usize| search.models.get(order - 1).map_or(f64::NAN, |model| model.test_error);
        piece.checks.push(Check::new(format!("MSE at order 2 over that at 3, {title}"), error(2) / error(3)));
        piece.checks.push(Check::new(format!("MSE at order 4 over that at 3, {title}"), error(4) / error(3)));
        piece.checks.push(Check::new(format!("chosen order, {title}"), chosen(search)));
        if title == "as printed" {
            let rise = error(5) / error(3);
            piece.checks.push(Check::new("MSE at order 5 over that at 3, as printed", rise));
        }
        let axes = (Axis::whole("order of the polynomial"), Axis::log("MSE on the test record"));
        draw(&mut piece, caption, axes, vec![Series::new("", Style::Joined, test_errors(search))])?;
    }
    Ok(piece)
}

/// Why a rig takes the place of the joint.
const JOINT: &str = "The recordings are not public. A linear joint with the constants of Table 3.5, kp = √10 (E16), a \
                     delay of 0.2 s, Coulomb friction of 0.02 N m and noise of 1 mrad takes the real one's place: \
                     trained on the sine, tested on a square wave.";

/// Figure 3.5: the test error by order on the virtual joint.
pub(crate) fn figure_3_5(_: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{JOINT} On it the error differs by a quarter from order 1 to 6, and orders 3 and 5 are alike: what makes order \
             5 the best on the thesis's joint is a property of that joint or of its excitation."
        ),
    );
    let mut series = Vec::new();
    for (equation, search) in Equation::BOTH.iter().zip(delayed_joint::of_the_page()?) {
        let symbol = equation.symbol();
        let curve = test_errors(search);
        let first = curve.first().map_or(f64::NAN, |p| p[1]);
        let least = curve.iter().map(|p| p[1]).fold(f64::INFINITY, f64::min);
        piece.checks.push(Check::new(format!("chosen order, {symbol}"), chosen(search)));
        piece.checks.push(Check::new(format!("MSE at order 1 over the least, {symbol}"), first / least));
        series.push(Series::new(symbol, Style::Joined, curve));
    }
    let axes = (Axis::whole("order of the polynomials"), Axis::linear("MSE on the test record"));
    draw(&mut piece, "Both equations of the virtual joint.", axes, series)?;
    Ok(piece)
}

/// The number that starts the names of an equation's rows.
fn number_of(equation: Equation) -> &'static str {
    match equation {
        Equation::Theta => "3.24",
        Equation::Alpha => "3.25",
    }
}

/// Table 3.4: the model of order 5 on the virtual joint.
pub(crate) fn table_3_4(fixture: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{JOINT} The virtual joint has no term of higher order, so the columns show what Algorithm 2 makes of order \
             5 where there is nothing to find; they are no test of the thesis's polynomials."
        ),
    );
    let (mut values, mut deviations) = (Vec::new(), Vec::new());
    for (equation, search) in Equation::BOTH.into_iter().zip(delayed_joint::of_the_page()?) {
        let model = search.models.get(4).context("no model of order 5")?;
        for term in delayed_joint::terms(equation, 5) {
            let name = format!("{}: {term}", number_of(equation));
            let (value, deviation) = delayed_joint::estimate(model, equation, &term);
            values.push((name.clone(), value));
            deviations.push((name, deviation));
        }
        let kept = model.active().len() as f64;
        piece.checks.push(Check::new(format!("terms kept at order 5, {}", equation.symbol()), kept));
    }
    // Every term must have its row in the thesis: `judge` refuses others.
    debug_assert!(values.iter().all(|(name, _)| fixture.row(name).is_some()));
    piece.columns.push(Column { title: "virtual joint, order 5".into(), values });
    piece.columns.push(Column { title: "its standard deviation".into(), values: deviations });
    Ok(piece)
}

/// τ from a kp τ²/2: a signed root, negative for a sign that no delay gives.
fn from_half_square(value: f64) -> f64 {
    let square = 2.0 * value / delayed_joint::TORQUE_PER_RADIAN;
    square.signum() * square.abs().sqrt()
}

/// The rows of Table 3.5.
fn parameters(values: [f64; 8]) -> Vec<(String, f64)> {
    let rows = [
        "Jeq + a*kp*tau^2/2",
        "Beq - a*kp*tau",
        "ks",
        "Jeq",
        "a*kp*tau^2/2",
        "a*kp*tau - Beq",
        "ks*(Jl + Jeq)/Jl",
        "tau",
    ];
    rows.map(String::from).into_iter().zip(values).collect()
}

/// Table 3.5: parameters and delay of the virtual joint by Algorithm 2 and by exact delay regression.
pub(crate) fn table_3_5(fixture: &Fixture) -> Result<Piece> {
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{JOINT} A sine of one frequency cannot tell the terms of the expansion apart: ks and Jeq of Algorithm 2 are \
             far off. The delay comes out from θ', but not from θ'' of 3.24; the thesis's own coefficients give four \
             delays between 0.14 s and 0.26 s. Regression with θ(t − τ) itself finds the delay and the parameters."
        ),
    );
    let (rig, gain) = (delayed_joint::RIG, delayed_joint::TORQUE_PER_RADIAN);
    let [theta, alpha] = delayed_joint::of_the_page()?;
    let of = |search: &Search, equation, order: usize, term: &str| {
        search.models.get(order - 1).map_or(f64::NAN, |m| delayed_joint::estimate(m, equation, term).0)
    };
    let base = |order, term: &str| of(theta, Equation::Theta, order, term);
    let link = |order, term: &str| of(alpha, Equation::Alpha, order, term);
    let half_square = -link(1, "theta''");
    piece.columns.push(Column {
        title: "virtual joint, Algorithm 2, order 1".into(),
        values: parameters([
            base(1, "theta''"),
            base(1, "theta'"),
            -base(1, "alpha"),
            link(1, "alpha''"),
            half_square,
            link(1, "theta'"),
            link(1, "alpha"),
            from_half_square(half_square),
        ]),
    });
    let off = 100.0 * (-base(1, "alpha") / rig.stiffness - 1.0);
    piece.checks.push(Check::new("ks by Algorithm 2, order 1, % off", off));
    let mut exact = Vec::new();
    for (which, name) in [(Which::Training, "sine"), (Which::Test, "square wave")] {
        let fit = delayed_joint::exact_delay(which)?;
        let [jeq, beq, minus_ks, _] = fit.coefficients[..] else { bail!("four coefficients were fitted") };
        let (tau, ks) = (fit.delay, -minus_ks);
        let half_square = 0.5 * gain * tau * tau;
        let ratio = (rig.link_inertia + jeq) / rig.link_inertia;
        piece.columns.push(Column {
            title: format!("virtual joint, exact delay, {name}"),
            values: parameters([
                jeq + half_square,
                beq - gain * tau,
                ks,
                jeq,
                half_square,
                gain * tau - beq,
                ks * ratio,
                tau,
            ]),
        });
        let off = 100.0 * (tau / DELAY - 1.0);
        piece.checks.push(Check::new(format!("delay by exact regression, {name}, % off"), off));
        let off = 100.0 * (ks / rig.stiffness - 1.0);
        piece.checks.push(Check::new(format!("ks by exact regression, {name}, % off"), off));
        exact.push(vec![format!("exact delay, {name}"), String::new(), number(tau), String::new()]);
    }

    let (jeq, beq) = (rig.base_inertia, rig.base_damping);
    let printed = |row: &str| fixture.number(row, "thesis");
    let routes = [
        (
            "θ'' of 3.24: Jeq + a·kp·τ²/2",
            from_half_square(printed("Jeq + a*kp*tau^2/2")? - jeq),
            [1, 5].map(|order| from_half_square(base(order, "theta''") - jeq)),
        ),
        (
            "θ' of 3.24: Beq − a·kp·τ",
            (beq - printed("Beq - a*kp*tau")?) / gain,
            [1, 5].map(|order| (beq - base(order, "theta'")) / gain),
        ),
        (
            "θ'' of 3.25: −a·kp·τ²/2, the thesis's choice",
            from_half_square(printed("a*kp*tau^2/2")?),
            [1, 5].map(|order| from_half_square(-link(order, "theta''"))),
        ),
        (
            "θ' of 3.25: a·kp·τ − Beq",
            (printed("a*kp*tau - Beq")? + beq) / gain,
            [1, 5].map(|order| (link(order, "theta'") + beq) / gain),
        ),
    ];
    let mut rows = Vec::new();
    for (name, thesis, ours) in routes {
        rows.push([vec![name.to_owned(), number(thesis)], ours.map(number).to_vec()].concat());
        let short = name.split(':').next().unwrap_or(name);
        piece.checks.push(Check::new(format!("delay from {short}, order 1, s"), ours[0]));
    }
    rows.extend(exact);
    let headings =
        ["τ in s from", "thesis's coefficients", "virtual joint, order 1", "virtual joint, order 5"];
    let caption =
        "Every route to the delay of 0.2 s; negative where the coefficient has a sign that no delay gives it";
    piece.tables.push(Table { caption: caption.into(), headings: headings.map(String::from).into(), rows });
    Ok(piece)
}
