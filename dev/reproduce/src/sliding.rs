//! Sliding-mode control of the identified link: section 4.2.

use anyhow::{Context, Result};
use greybox_control::Metrics;
use greybox_eso::{Observer as Chain, Scheme};
use greybox_simulate::rigs::{LinkRun, RigError, RotaryFlexibleLink, Sampling, square_wave};
use greybox_smc::thesis::{LinkTangent, PrintedLaw};
use greybox_smc::{
    BoundaryLayer, Design, Equilibrium, EquilibriumSolver, Law, Surface, Tangent, Target, smooth_sign,
};

use super::chapter2::draw;
use super::fixture::Fixture;
use super::index::number;
use super::{Check, Piece, Status, Table};
use greybox_dev::figure::{Axis, Series, Style};

/// Sample time, s.
const DT: f64 = 5e-4;
/// The square reference, Hz; the thesis states neither its frequency nor its amplitude.
const FREQUENCY: f64 = 0.25;
/// Limit of the amplifier, V.
const LIMIT: f64 = 10.0;
/// Velocity over which the friction in the law is smoothed, rad/s.
const SMOOTHING: f64 = 0.05;

const RIG: RotaryFlexibleLink = RotaryFlexibleLink::IDENTIFIED;

const ASSUMED: &str = "The identified link with its friction, sampled every 0.5 ms, the voltage limited to 10 V, on a \
                       square wave of 0.25 Hz; the thesis states neither its frequency nor its amplitude.";

/// f(x) of a rig for its laws, friction smoothed.
fn f(rig: &RotaryFlexibleLink, x: [f64; 4]) -> [f64; 4] {
    rig.drift(x, smooth_sign(x[2], SMOOTHING))
}

/// What a law did on the square wave, and its surface.
struct Followed {
    run: LinkRun,
    surface: Vec<f64>,
    /// Largest voltage before the limit.
    asked: f64,
}

impl Followed {
    /// Two periods between ± `amplitude`, rad, from rest.
    fn new(
        rig: &RotaryFlexibleLink,
        amplitude: f64,
        law: impl Fn([f64; 4], f64) -> greybox_smc::Command,
    ) -> Result<Self> {
        let samples = (2.0 / FREQUENCY / DT) as usize;
        let mut surface = Vec::with_capacity(samples);
        let mut asked = 0.0f64;
        let run = rig.run_with_state(Sampling { dt: DT, substeps: 2 }, [0.0; 4], samples, |k, x| {
            let command = law(x, reference(amplitude, k));
            surface.push(command.surface);
            asked = asked.max(command.unlimited.abs());
            command.u
        })?;
        Ok(Self { run, surface, asked })
    }

    /// The step from −`amplitude` to `amplitude` in the middle.
    fn step(&self, amplitude: f64) -> Result<Metrics> {
        let half = self.run.states.len() / 4;
        let at = 2 * half..3 * half;
        let angles: Vec<f64> = self.run.states[at.clone()].iter().map(|x| x[0]).collect();
        let metrics = Metrics::of(&angles, &self.run.voltages[at], amplitude, DT, (-LIMIT, LIMIT));
        metrics.context("no step to look at")
    }

    fn deflection(&self) -> f64 {
        self.run.states.iter().map(|x| x[1].abs()).fold(0.0, f64::max).to_degrees()
    }

    fn voltage(&self) -> f64 {
        self.run.voltages.iter().map(|v| v.abs()).fold(0.0, f64::max)
    }

    fn steepest(&self) -> f64 {
        self.surface.iter().map(|s| s.abs()).fold(0.0, f64::max)
    }
}

/// Infinite where the step never settles.
pub(crate) fn settling(step: &Metrics) -> f64 {
    step.settling.unwrap_or(f64::INFINITY)
}

fn reference(amplitude: f64, sample: usize) -> f64 {
    square_wave(amplitude, FREQUENCY, (sample as f64 + 0.5) * DT)
}

/// Every tenth sample.
fn thin(values: impl Iterator<Item = f64>) -> Vec<[f64; 2]> {
    values.enumerate().step_by(10).map(|(k, v)| [k as f64 * DT, v]).collect()
}

/// The law of the thesis (erratum E20), with a command of zero where it gives none.
fn printed() -> Result<impl Fn([f64; 4], f64) -> greybox_smc::Command> {
    let law = PrintedLaw::new(LinkTangent::IDENTIFIED, 16.0, 5e4, 500.0, LIMIT)?;
    Ok(move |x: [f64; 4], wanted: f64| law.step(&x, f(&RIG, x)[2], wanted).unwrap_or(STOPPED))
}

/// When the law as 4.19 prints it, with y_f⁗ (that of the last sample) in the place of ÿ_f, has taken the link out of the
/// range of its model, s; not finite when it does not.
fn by_the_letter(amplitude: f64) -> Result<f64> {
    let law = PrintedLaw::new(LinkTangent::IDENTIFIED, 16.0, 5e4, 500.0, LIMIT)?;
    let samples = (2.0 / FREQUENCY / DT) as usize;
    let mut fourth = 0.0;
    let run = RIG.run_with_state(Sampling { dt: DT, substeps: 2 }, [0.0; 4], samples, |k, x| {
        let drift = f(&RIG, x);
        let command =
            law.step_by_the_letter(&x, drift[2], fourth, reference(amplitude, k)).unwrap_or(STOPPED);
        fourth = drift[3] + RIG.input()[3] * command.u;
        command.u
    });
    match run {
        Err(RigError::OutOfRange { time, .. }) => Ok(time),
        Err(other) => Err(other.into()),
        Ok(_) => Ok(f64::INFINITY),
    }
}

const STOPPED: greybox_smc::Command =
    greybox_smc::Command { u: 0.0, unlimited: 0.0, surface: 0.0, saturated: false };

/// The thesis' settings with the target at the equilibrium of the model instead of (θ_d, 0, 0, 0).
fn with_equilibrium(
    rig: RotaryFlexibleLink,
    amplitude: f64,
) -> Result<impl Fn([f64; 4], f64) -> greybox_smc::Command> {
    let (smooth, g) = (RIG.without_friction(), rig.input());
    let model = move |x: &[f64; 4], u: f64| {
        let f = f(&smooth, *x);
        std::array::from_fn(|i| f[i] + g[i] * u)
    };
    let solver = EquilibriumSolver::new(0)?;
    let at = |theta: f64| solver.solve(model, theta, &Equilibrium::ORIGIN);
    let (above, below) = (at(amplitude)?, at(-amplitude)?);
    let (surface, layer) = (Surface::repeated(16.0)?, BoundaryLayer::new(5e4, 500.0)?);
    let thesis = LinkTangent::IDENTIFIED;
    let whole: Tangent<4> = solver.tangent(model, &above)?;
    let law: Law<4> = Design::new(thesis.tangent(), surface, layer, DT)
        .input_gain(thesis.b_alpha)
        .plant(whole)
        .limited_to(LIMIT)
        .law()?;
    Ok(move |x: [f64; 4], wanted: f64| {
        let rest = if wanted > 0.0 { above.state } else { below.state };
        law.step(&x, &f(&rig, x), &g, &Target::rest(rest)).unwrap_or(STOPPED)
    })
}

/// Time for which a set point is held to see what the loop does at rest, s.
const HELD: f64 = 20.0;

/// What a law does at a set point that is held: lowest and highest error of the last quarter of the time, degrees, and
/// between what the voltage goes, V.
fn at_rest(law: impl Fn([f64; 4], f64) -> greybox_smc::Command, amplitude: f64) -> Result<[[f64; 2]; 2]> {
    let samples = (HELD / DT) as usize;
    let run =
        RIG.run_with_state(Sampling { dt: DT, substeps: 2 }, [0.0; 4], samples, |_, x| law(x, amplitude).u)?;
    let from = samples - samples / 4;
    let range = |values: &mut dyn Iterator<Item = f64>| {
        values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
    };
    let error = |x: &[f64; 4]| (x[0] - amplitude).to_degrees();
    Ok([range(&mut run.states[from..].iter().map(error)), range(&mut run.voltages[from..].iter().copied())])
}

/// The law of the thesis without its friction term.
fn uncompensated() -> Result<impl Fn([f64; 4], f64) -> greybox_smc::Command> {
    let law = PrintedLaw::new(LinkTangent::IDENTIFIED, 16.0, 5e4, 500.0, LIMIT)?;
    let rig = RIG.without_friction();
    Ok(move |x: [f64; 4], wanted: f64| law.step(&x, f(&rig, x)[2], wanted).unwrap_or(STOPPED))
}

/// When the corrected law, given the angles and what the thesis's observer makes of their rates, has taken the link out of
/// the range of its model, s; not finite when it does not. Nothing is noisy.
fn with_the_observer_of_the_thesis(amplitude: f64) -> Result<f64> {
    let law = printed()?;
    let chain = || Chain::new(greybox_eso::Design::thesis(), DT, Scheme::Euler);
    let (mut theta, mut alpha) = (chain()?, chain()?);
    let samples = (2.0 / FREQUENCY / DT) as usize;
    let run = RIG.run_with_state(Sampling { dt: DT, substeps: 2 }, [0.0; 4], samples, |k, x| {
        let rates = [theta.update(x[0], 0.0)[1], alpha.update(x[1], 0.0)[1]];
        law([x[0], x[1], rates[0], rates[1]], reference(amplitude, k)).u
    });
    match run {
        Err(RigError::OutOfRange { time, .. }) => Ok(time),
        Err(other) => Err(other.into()),
        Ok(_) => Ok(f64::INFINITY),
    }
}

/// Figure 4.1.
pub(crate) fn figure_4_1(_: &Fixture) -> Result<Piece> {
    let amplitude = 30f64.to_radians();
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{ASSUMED} The law is 4.19 with erratum E20, with the thesis' λ, η and φ. It ends a degree off, for its target \
             is no equilibrium; with the target at the equilibrium of the model it ends where it should, with friction \
             within what the smoothed compensation leaves. Neither comes to rest: held at 30° for 20 s the law hunts about the \
             friction that it compensates, for ever; without its friction term it rests. The thesis gives the law the true \
             rates; with those of its own observer, which lag by 25 ms, it loses the link."
        ),
    );
    let ours = Followed::new(&RIG, amplitude, printed()?)?;
    let rest = Followed::new(&RIG, amplitude, with_equilibrium(RIG, amplitude)?)?;
    let mut rows = Vec::new();
    for (name, followed) in [("printed law, corrected", &ours), ("target at the equilibrium", &rest)] {
        let step = followed.step(amplitude)?;
        rows.push(vec![
            name.to_owned(),
            number(settling(&step)),
            number(100.0 * step.overshoot),
            number(step.final_error.abs().to_degrees()),
            number(followed.deflection()),
            number(followed.voltage()),
        ]);
    }
    let step = ours.step(amplitude)?;
    let lost = by_the_letter(amplitude)?;
    let mut still = Vec::new();
    for (name, [error, volts]) in [
        ("printed law, corrected", at_rest(printed()?, amplitude)?),
        ("target at the equilibrium", at_rest(with_equilibrium(RIG, amplitude)?, amplitude)?),
        ("printed law without its friction term", at_rest(uncompensated()?, amplitude)?),
    ] {
        still.push(
            [vec![name.to_owned()], [error, volts].concat().into_iter().map(number).collect()].concat(),
        );
        let moves = error[1] - error[0];
        piece.checks.push(Check::new(format!("{name}: peak to peak at rest in degrees"), moves));
    }
    let observed = with_the_observer_of_the_thesis(amplitude)?;
    piece
        .checks
        .push(Check::new("law with the observer of the thesis: time until it leaves ±40° in s", observed));
    piece.checks.push(Check::new("printed law: largest voltage that it asks for in V", ours.asked));
    piece.checks.push(Check::new("law by the letter of 4.19: time until it leaves ±40° in s", lost));
    piece.checks.push(Check::new("printed law: settling in s", settling(&step)));
    piece.checks.push(Check::new("printed law: overshoot in %", 100.0 * step.overshoot));
    piece.checks.push(Check::new("printed law: largest deflection in degrees", ours.deflection()));
    // Without friction the target at the equilibrium leaves nothing.
    let mut worst: f64 = 0.0;
    for degrees in [10.0, 15.0, 20.0, 25.0, 30.0_f64] {
        let amplitude = degrees.to_radians();
        let still = RIG.without_friction();
        let step = Followed::new(&still, amplitude, with_equilibrium(still, amplitude)?)?.step(amplitude)?;
        worst = worst.max(step.final_error.abs().to_degrees());
        rows.push(vec![
            format!("target at the equilibrium, no friction, {degrees}°"),
            number(settling(&step)),
            number(100.0 * step.overshoot),
            number(step.final_error.abs().to_degrees()),
            String::new(),
            String::new(),
        ]);
    }
    piece
        .checks
        .push(Check::new("equilibrium, no friction, 10° to 30°: largest error left in degrees", worst));
    piece.tables.push(Table {
        caption: "The step from −30° to 30° in the middle of two periods.".into(),
        headings: [
            "law",
            "settling (2 %) in s",
            "overshoot in %",
            "error left in degrees",
            "largest α in degrees",
            "largest voltage in V",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows,
    });
    piece.tables.push(Table {
        caption: "The last 5 of 20 seconds at a set point of 30°.".into(),
        headings: ["law", "least error in degrees", "largest", "least voltage in V", "largest"]
            .map(str::to_owned)
            .to_vec(),
        rows: still,
    });
    let axis = || Axis::linear("time in s");
    let column = |followed: &Followed, i: usize| thin(followed.run.states.iter().map(|x| x[i].to_degrees()));
    let samples = ours.run.states.len();
    let square = thin((0..samples).map(|k| reference(amplitude, k).to_degrees()));
    let series = vec![
        Series::new("reference", Style::Dashed, square),
        Series::new("printed law", Style::Line, column(&ours, 0)),
        Series::new("equilibrium", Style::Line, column(&rest, 0)),
    ];
    draw(&mut piece, "Hub angle.", (axis(), Axis::linear("θ in degrees")), series)?;
    let series = vec![
        Series::new("printed law", Style::Line, column(&ours, 1)),
        Series::new("equilibrium", Style::Line, column(&rest, 1)),
    ];
    draw(&mut piece, "Deflection of the link.", (axis(), Axis::linear("α in degrees")), series)?;
    let series = vec![
        Series::new("printed law", Style::Line, thin(ours.run.voltages.iter().copied())),
        Series::new("equilibrium", Style::Line, thin(rest.run.voltages.iter().copied())),
    ];
    draw(&mut piece, "Voltage.", (axis(), Axis::linear("V")), series)?;
    Ok(piece)
}

/// Figure 4.2.
pub(crate) fn figure_4_2(fixture: &Fixture) -> Result<Piece> {
    let phi = fixture.number("φs", "thesis")?;
    let mut piece = Piece::new(
        Status::VirtualRig,
        format!(
            "{ASSUMED} s jumps with the reference and decays with η/φ = 100 per second; it never comes near φ = {phi}, so \
             that the law is the linear one inside its layer and nothing slides (erratum E21)."
        ),
    );
    let (mut series, mut largest) = (Vec::new(), 0.0_f64);
    for degrees in [15.0, 30.0_f64] {
        let ours = Followed::new(&RIG, degrees.to_radians(), printed()?)?;
        largest = largest.max(ours.steepest());
        let points = thin(ours.surface.iter().copied());
        series.push(Series::new(format!("±{degrees}°"), Style::Line, points));
    }
    piece.checks.push(Check::new("largest |s| over φ", largest / phi));
    draw(
        &mut piece,
        "The sliding variable.",
        (Axis::linear("time in s"), Axis::linear("s in rad/s")),
        series,
    )?;
    Ok(piece)
}
