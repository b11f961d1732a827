//! Chapter 3: identification with time delay.

use std::f64::consts::TAU;

use anyhow::{Context, Result};
use greybox_eso::{Design, Observer, Scheme, record};
use greybox_simulate::rigs::{RotaryFlexibleJoint, Sampling};

use super::algorithm2::{figure_3_1, figure_3_5, table_3_1, table_3_4, table_3_5};
use super::chapter2::{Beam, photograph, relative_rms};
use super::delayed_joint::STEP;
use super::fixture::Fixture;
use super::index::number;
use super::{Check, Column, Drawing, Entry, Piece, Status, Table};
use greybox_dev::figure::{Axis, Plot, Series, Style};

/// Its tables and figures, in order.
pub(crate) fn entries() -> Vec<Entry> {
    vec![
        Entry::new("Table 3.1", table_3_1).slow(),
        Entry::new("Table 3.2", table_3_2),
        Entry::new("Figure 3.1", figure_3_1),
        Entry::new("Figure 3.2", photograph),
        Entry::new("Table 3.3", table_3_3),
        Entry::new("Figure 3.3", figure_3_3),
        Entry::new("Figure 3.4", figure_3_4),
        Entry::new("Figure 3.5", figure_3_5),
        Entry::new("Table 3.4", table_3_4),
        Entry::new("Table 3.5", table_3_5),
    ]
}

/// The gain of the proportional control in section 3.3.
const KP: f64 = 2.0;

/// Physical parameters from the coefficients of equation 3.9, with the signs of erratum E12.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Physical {
    tau: f64,
    m: f64,
    c1: f64,
    k1: f64,
}

/// kp τ³/6 on x''', m − kp τ²/2 on x'', c1 + kp τ on x', k1 − kp on x.
///
/// As E12 asks: 3.12 is printed with the opposite signs of the last three. The cube root is the real one, a
/// negative coefficient gives a negative delay.
fn physical(kp: f64, jerk: f64, inertia: f64, damping: f64, stiffness: f64) -> Physical {
    let tau = (6.0 * jerk / kp).cbrt();
    Physical { tau, m: inertia + 0.5 * kp * tau * tau, c1: damping - kp * tau, k1: stiffness + kp }
}

/// Table 3.2 from the coefficients that Table 3.1 prints.
fn table_3_2(fixture: &Fixture) -> Result<Piece> {
    let from_table = physical(KP, 0.001515, 0.9611, 1.3922, 3.9830);
    let exact = physical(KP, 0.0026667, 0.96, 1.4, 4.0);
    let values = vec![
        ("m".to_owned(), from_table.m),
        ("k1".to_owned(), from_table.k1),
        ("c1".to_owned(), from_table.c1),
        ("tau".to_owned(), from_table.tau),
    ];
    let (mut to_thesis, mut to_truth): (f64, f64) = (0.0, 0.0);
    for (row, value) in &values {
        to_thesis = to_thesis.max((value - fixture.number(row, "thesis")?).abs());
    }
    for (row, value) in [("m", exact.m), ("k1", exact.k1), ("c1", exact.c1), ("tau", exact.tau)] {
        to_truth = to_truth.max((value - fixture.number(row, "truth")?).abs());
    }
    // With the signs of 3.12 as printed.
    let tau = from_table.tau;
    let as_printed = [("m", 0.9611 - 0.5 * KP * tau * tau), ("c1", 1.3922 + KP * tau), ("k1", 3.9830 - KP)];
    let mut rows = Vec::new();
    for (name, wrong) in as_printed {
        let ours = values.iter().find(|(row, _)| row == name).map_or(f64::NAN, |(_, value)| *value);
        rows.push(vec![name.into(), number(fixture.number(name, "thesis")?), number(ours), number(wrong)]);
    }
    let mut piece = Piece::new(
        Status::Constants,
        "What the coefficients printed in Table 3.1 imply, with the signs of erratum E12: the thesis's two tables \
         agree. k3, c2 and c3 stand in Table 3.1 as they are. An estimate of ours is not in this table.",
    );
    piece.columns.push(Column { title: "from Table 3.1's coefficients".into(), values });
    let headings = ["", "thesis", "signs of E12", "signs as printed in 3.12"].map(String::from).into();
    piece.tables.push(Table {
        caption: "Which signs of equation 3.12 the thesis used".into(),
        headings,
        rows,
    });
    piece.checks.push(Check::new("largest gap to Table 3.2, from Table 3.1", to_thesis));
    piece
        .checks
        .push(Check::new("largest gap to the selected values, from the exact coefficients", to_truth));
    Ok(piece)
}

/// Table 3.3: constants, and the nominal column of Table 3.5 that contradicts them (E8, E10).
fn table_3_3(fixture: &Fixture) -> Result<Piece> {
    let (printed, consistent) = (Beam::read(fixture, "thesis")?, Beam::read(fixture, "truth")?);
    let a = 1.0 / consistent.volts_per_torque();
    // E16: the gain that both entries of Table 3.5 need, which the text does not state.
    let kp = 10f64.sqrt();
    let tau = 0.2;
    let row = |name: &str, thesis: f64, printed: f64, consistent: f64| {
        vec![name.to_owned(), number(thesis), number(printed), number(consistent)]
    };
    let nominal = 0.5 * a * kp * tau * tau;
    let rows = vec![
        row("ks·(Jl + Jeq)/Jl", 2.0501, printed.joint_stiffness(), consistent.joint_stiffness()),
        row("a·kp·τ²/2 with kp = √10, τ = 0.2 s", 0.008121, nominal, nominal),
        row("Jeq + a·kp·τ²/2", 0.0102, 9.76e-5 + nominal, 0.002084 + nominal),
        row("Beq − a·kp·τ", -0.0662, 0.015 - a * kp * tau, 0.015 - a * kp * tau),
    ];
    let mut piece = Piece::new(
        Status::Constants,
        "Data-sheet values, the same as in Table 2.2. Jeq contradicts the nominal column of Table 3.5; the last column \
         is the set that agrees with it.",
    );
    let headings = ["", "Table 3.5, nominal", "from the constants as printed", "from the consistent set"];
    piece.tables.push(Table {
        caption: "What the constants give, beside the nominal column of Table 3.5; a = ηg·kg·ηm·kt/Rm".into(),
        headings: headings.map(String::from).into(),
        rows,
    });
    piece.checks.push(Check::new("ks*(Jl + Jeq)/Jl, consistent", consistent.joint_stiffness()));
    piece.checks.push(Check::new("a*kp*tau^2/2 against Table 3.5", nominal / 0.008121));
    piece.checks.push(Check::new("Beq - a*kp*tau against Table 3.5", (0.015 - a * kp * tau) / -0.0662));
    Ok(piece)
}

/// Figure 3.3: the joint follows 2 sin(2π 0.66 t).
fn figure_3_3(fixture: &Fixture) -> Result<Piece> {
    let (amplitude, frequency) = reference_of(fixture)?;
    response(fixture, |t| amplitude * (TAU * frequency * t).sin())
}

/// Figure 3.4: the joint follows a square wave.
fn figure_3_4(fixture: &Fixture) -> Result<Piece> {
    let (amplitude, frequency) = reference_of(fixture)?;
    response(fixture, |t| if (frequency * t).fract() < 0.5 { amplitude } else { -amplitude })
}

fn reference_of(fixture: &Fixture) -> Result<(f64, f64)> {
    let get = |row: &str| fixture.number(row, "thesis");
    Ok((get("amplitude of the reference")?, get("frequency of the reference")?))
}

/// Seconds of the record that are drawn.
const SHOWN: f64 = 10.0;

/// The four signals of figures 3.3 and 3.4 on the virtual joint, for one minute, and how well the observer of
/// equation 3.27 estimates the velocities.
fn response(fixture: &Fixture, reference: impl Fn(f64) -> f64) -> Result<Piece> {
    // The loop ten times as fast as the records: the thesis's controller is continuous.
    let fast = 10;
    let sampling = Sampling { dt: STEP / fast as f64, substeps: 1 };
    let samples = (60.0 / sampling.dt).round() as usize + 1;
    let run = RotaryFlexibleJoint::LINEAR.run(sampling, [0.0; 4], samples, &reference)?;
    let column = |state: usize| -> Vec<f64> { run.states.iter().step_by(fast).map(|x| x[state]).collect() };
    let voltage: Vec<f64> = run.voltages.iter().step_by(fast).copied().collect();
    let (theta, alpha) = (column(0), column(1));
    let wanted: Vec<f64> = (0..theta.len()).map(|k| reference(k as f64 * STEP)).collect();
    let mut piece = Piece::new(
        Status::VirtualRig,
        "The recordings are not public. A linear joint with the constants of Table 3.5, kp = √10 (E16) and the delay of \
         0.2 s takes the place of the real one: free of noise and friction, and without the amplifier's limit of 10 V.",
    );
    let largest = |values: &[f64]| values.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
    piece.checks.extend([
        Check::new("theta at 1 s, rad", theta[1000]),
        Check::new("theta at 5 s, rad", theta[5000]),
        Check::new("theta at 20 s, rad", theta[20_000]),
        Check::new("alpha at 20 s, rad", alpha[20_000]),
        Check::new("largest theta, rad", largest(&theta)),
        Check::new("largest alpha, rad", largest(&alpha)),
        Check::new("largest voltage, V", largest(&voltage)),
    ]);

    let mut draw = |caption: &str, unit: &str, series: Vec<(&str, Style, &[f64])>| -> Result<()> {
        let curves = series.into_iter().map(|(label, style, values)| {
            let points = values.iter().enumerate().step_by(10).map(|(k, v)| [k as f64 * STEP, *v]);
            Series::new(label, style, points.take_while(|p| p[0] <= SHOWN).collect())
        });
        let plot = Plot {
            alt: format!("{}: {caption}", fixture.id),
            x: Axis::linear("time in s"),
            y: Axis::linear(unit),
            series: curves.collect(),
        };
        let svg = plot.to_svg().with_context(|| format!("{caption}: nothing to draw"))?;
        piece.figures.push(Drawing { caption: caption.into(), svg });
        Ok(())
    };
    draw("Motor voltage.", "V_m in V", vec![("", Style::Line, &voltage)])?;
    draw(
        "Angle of the base and its reference.",
        "angle in rad",
        vec![("θ", Style::Line, &theta), ("θ_d", Style::Dashed, &wanted)],
    )?;
    draw("Deflection of the joint.", "α in rad", vec![("", Style::Line, &alpha)])?;
    for (name, angle, rate) in [("theta", &theta, column(2)), ("alpha", &alpha, column(3))] {
        let observer = Observer::new(Design::thesis(), STEP, Scheme::Euler)?;
        let (mut literal, mut ahead) = (vec![[0.0; 2]; angle.len()], vec![[0.0; 2]; angle.len()]);
        let complete = record::lag_compensated(&observer, angle, None, &mut literal, &mut ahead)?;
        let estimate: Vec<f64> = literal.iter().map(|z| z[1]).collect();
        let compensated: Vec<f64> = ahead.iter().map(|z| z[1]).collect();
        let off = |estimate: &[f64]| relative_rms(&estimate[1000..complete], &rate[1000..complete]);
        let symbol = if name == "theta" { "θ'" } else { "α'" };
        draw(
            &format!(
                "{symbol}, and its estimate by the observer of equation 3.27, which lags by 25 ms (E6)."
            ),
            &format!("{symbol} in rad/s"),
            vec![("true", Style::Line, &rate), ("z₂", Style::Dashed, &estimate)],
        )?;
        let literal_error = off(&estimate);
        let compensated_error = off(&compensated);
        piece.checks.push(Check::new(format!("{name}' by the observer, relative rms error"), literal_error));
        piece.checks.push(Check::new(
            format!("{name}' by the observer, lag taken out, relative rms error"),
            compensated_error,
        ));
    }
    Ok(piece)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_go_there_and_back() {
        let (kp, tau) = (KP, 0.17_f64);
        let (m, c1, k1) = (1.3, 0.4, 5.0);
        let back = physical(kp, kp * tau.powi(3) / 6.0, m - kp * tau * tau / 2.0, c1 + kp * tau, k1 - kp);
        for (a, b) in [(back.tau, tau), (back.m, m), (back.c1, c1), (back.k1, k1)] {
            assert!((a - b).abs() < 1e-14);
        }
    }

    #[test]
    fn the_coefficients_in_use_are_those_of_table_3_1() {
        let folder = greybox_dev::root().join("fixtures").join("thesis");
        let table = Fixture::read(&folder, "Table 3.1").unwrap();
        let get = |row: &str| table.number(row, "thesis").unwrap();
        assert_eq!(
            physical(KP, get("x'''"), get("x''"), get("x'"), get("x")),
            physical(KP, 0.001515, 0.9611, 1.3922, 3.9830)
        );
    }

    #[test]
    fn a_negative_coefficient_gives_a_negative_delay() {
        assert!(physical(KP, -0.001515, 1.0, 1.0, 1.0).tau < -0.1);
    }
}
