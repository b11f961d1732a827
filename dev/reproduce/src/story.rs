//! What finding the physics buys: one design, made on the nominal, the calibrated and the improved model of the demo,
//! each law run on the virtual rig that made the demo's recordings.

use std::path::Path;

use anyhow::{Context, Result};
use greybox_control::{
    ControlError, Controller, DesignOptions, Integral, Method, Metrics, ObserverMethod, OutputFeedback,
    OutputOptions, Plant, PlantOptions, Sensor, design,
};
use greybox_model::Model;
use greybox_report::Report;
use greybox_report::contract::{Ordered, Parameter};
use greybox_simulate::rigs::{LinkRun, RigError, RotaryFlexibleLink, Sampling, VoltageBalance};

use super::chapter2::draw;
use super::index::number;
use super::{Check, Entry, Piece, Status, Table};
use greybox_dev::demo::Demo;
use greybox_dev::figure::{Axis, Series, Style};

const RIG: RotaryFlexibleLink = RotaryFlexibleLink::IDENTIFIED;
/// Sample time of the laws, s.
const DT: f64 = 1e-3;
/// Limit of the amplifier, V.
const LIMIT: f64 = 10.0;
/// Time for each set point, s.
const HOLD: f64 = 1.5;
/// Set points of a run.
const STEPS: usize = 5;
/// Amplitudes of the square wave, degrees: that of the held-out recording, and its half, where friction weighs more.
const AMPLITUDES: [f64; 2] = [20.0, 10.0];
/// Typical sizes of the states, rad and rad/s, and of the voltage.
const SIZES: [(&str, f64); 4] = [("theta", 0.35), ("alpha", 0.1), ("theta'", 5.0), ("alpha'", 5.0)];
const VOLTS: f64 = 5.0;
/// λ and η/φ of the thesis's sliding mode (section 4.2), 1/s.
const SLIDING: (f64, f64) = (16.0, 100.0);
/// Bandwidth of the extended-state observers, 1/s.
const BANDWIDTH: f64 = 300.0;
/// One count of an encoder of 4096 counts a turn, rad.
const COUNT: f64 = std::f64::consts::TAU / 4096.0;
const MODELS: [&str; 3] = ["nominal", "calibrated", "improved"];

/// The piece.
pub(crate) fn entry() -> Entry {
    Entry::new("Story", |_| story(&Answer::of_diagnosis()?))
        .slow()
        .or_from_demo(|out| story(&Answer::read(out)?))
}

/// What the diagnosis of the demo says.
struct Answer {
    nominal: Model,
    calibrated: Model,
    improved: Model,
    /// Cells: kind, equations, share of the residual, confidence.
    found: Vec<Vec<String>>,
}

impl Answer {
    fn of_diagnosis() -> Result<Self> {
        let diagnosis = Demo::read()?.diagnose()?;
        let found = diagnosis.mechanisms.iter();
        Ok(Self {
            found: found.map(|m| cells(&m.kind, &m.equations, m.share_explained, m.confidence)).collect(),
            nominal: diagnosis.nominal,
            calibrated: diagnosis.calibrated,
            improved: diagnosis.improved,
        })
    }

    /// From what `greybox demo link --out OUT` left.
    fn read(out: &Path) -> Result<Self> {
        let text = |name: &str| {
            let path = out.join(name);
            std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))
        };
        let model = |name: &str| -> Result<Model> { Ok(Model::from_toml(&text(name)?, name)?) };
        let report = Report::from_json(&text("report.json")?)?;
        let nominal = model("rotary_link.toml")?;
        let calibrated = refitted(&nominal, &report.parameters)?;
        let found = report.mechanisms.iter();
        Ok(Self {
            found: found
                .map(|m| cells(&m.kind, m.equation.as_slice(), m.share_explained, m.confidence))
                .collect(),
            nominal,
            calibrated,
            improved: model("improved.toml")?,
        })
    }
}

/// The equations of a model with the parameters to which a report says that they were refitted, each in its own unit.
fn refitted(nominal: &Model, parameters: &Ordered<Parameter>) -> Result<Model> {
    let mut model = nominal.clone();
    for parameter in &mut model.parameters {
        let reported = parameters.get(&parameter.name).and_then(|p| p.calibrated);
        let reported =
            reported.with_context(|| format!("report.json: no refitted value of `{}`", parameter.name))?;
        parameter.value = parameter.unit.as_ref().map_or(reported, |unit| unit.to_si(reported));
    }
    Ok(model)
}

fn cells(kind: &str, equations: &[String], share: f64, confidence: f64) -> Vec<String> {
    vec![kind.to_owned(), equations.join(", "), number(share), number(confidence)]
}

/// One way to design.
struct Way {
    name: &'static str,
    method: Method,
    compensated: bool,
    /// The observer between the encoders and the law, which else is given the true state; its integral action.
    observer: Option<(ObserverMethod, Integral)>,
}

impl Way {
    /// The way for its own sake, not for comparison.
    fn is_shown(&self) -> bool {
        !self.compensated && self.observer.is_none()
    }
}

fn ways() -> [Way; 7] {
    let eta = 10.0 * VOLTS;
    let regulator = || Way { name: "regulator", method: Method::Lqr, compensated: false, observer: None };
    let kalman = ObserverMethod::Kalman { disturbance: 0.2 * VOLTS };
    let eso = ObserverMethod::Eso { bandwidth: BANDWIDTH };
    let sliding = || Method::Smc { lambda: SLIDING.0, eta, phi: eta / SLIDING.1 };
    [
        regulator(),
        Way { name: "sliding mode", method: sliding(), compensated: false, observer: None },
        Way {
            name: "sliding mode, friction compensated",
            method: sliding(),
            compensated: true,
            observer: None,
        },
        Way { name: "regulator, Kalman filter", observer: Some((kalman, Integral::Off)), ..regulator() },
        Way {
            name: "regulator, extended-state observer",
            observer: Some((eso, Integral::Off)),
            ..regulator()
        },
        Way {
            name: "regulator, Kalman filter, integral action",
            observer: Some((kalman, Integral::Disturbance)),
            ..regulator()
        },
        Way {
            name: "regulator, Kalman filter, integral action at rest",
            observer: Some((kalman, Integral::AtRest { time: None })),
            ..regulator()
        },
    ]
}

/// `None` where the design is refused, since the loop would be unstable.
fn law(model: &Model, way: &Way, amplitude: f64) -> Result<Option<Controller>> {
    let sizes = SIZES.map(|(name, size)| (name.to_owned(), size)).to_vec();
    let options = PlantOptions { sizes, input_size: VOLTS, ..PlantOptions::default() };
    let plant = Plant::of(model, "v", &options)?;
    let wanted = DesignOptions {
        limit: Some(LIMIT),
        compensate_friction: way.compensated,
        ..DesignOptions::new("theta", &[-amplitude, amplitude], DT)
    };
    match design(&plant, &way.method, &wanted) {
        Err(ControlError::Unstable { .. } | ControlError::UnstableSampled { .. }) => Ok(None),
        other => Ok(Some(other?)),
    }
}

/// An observer behind encoders of both angles.
fn observer(law: &Controller, method: ObserverMethod, integral: Integral) -> Result<OutputFeedback> {
    let encoder = Sensor { noise: 0.0, resolution: COUNT };
    let sensors = ["theta", "alpha"].map(|name| (name.to_owned(), encoder)).to_vec();
    Ok(OutputFeedback::new(law, &OutputOptions { method, sensors, integral })?)
}

fn samples() -> usize {
    (HOLD / DT).round() as usize
}

fn reference(amplitude: f64, k: usize) -> f64 {
    if (k / samples()).is_multiple_of(2) { amplitude } else { -amplitude }
}

/// A law on the rig, given the true state (what differs comes from the model alone) or what its observer makes of two
/// encoders. `Err` with the time at which it took the hub out of the range of the rig.
fn run(
    rig: &RotaryFlexibleLink,
    law: &Controller,
    observer: Option<&OutputFeedback>,
    amplitude: f64,
) -> Result<Result<LinkRun, f64>> {
    let names = law.plant().state_names();
    let order = ["theta", "alpha", "theta'", "alpha'"];
    let places: Vec<usize> = names
        .iter()
        .map(|name| {
            order.iter().position(|r| r == name).with_context(|| format!("the rig has no state {name}"))
        })
        .collect::<Result<_>>()?;
    let sampling = Sampling { dt: DT, substeps: 4 };
    let mut memory = observer.map(OutputFeedback::start);
    let run = rig.run_with_state(sampling, [0.0; 4], STEPS * samples(), |k, x| {
        let known: Vec<f64> = places.iter().map(|&i| x[i]).collect();
        match (observer, &mut memory) {
            (Some(observer), Some(memory)) => {
                let read = |&i: &usize| (known[i] / COUNT).round() * COUNT;
                let y: Vec<f64> = observer.observer().measured().iter().map(read).collect();
                observer.command(memory, &y, reference(amplitude, k))
            }
            _ => law.command(&known, reference(amplitude, k)),
        }
    });
    match run {
        Ok(run) => Ok(Ok(run)),
        Err(RigError::OutOfRange { time, .. }) => Ok(Err(time)),
        Err(other) => Err(other.into()),
    }
}

/// The worst of the steps from end to end; infinite for a law that lost the rig.
#[derive(Clone, Copy)]
struct Reached {
    settling: f64,
    overshoot: f64,
    left: f64,
    moves: f64,
    rms: f64,
    largest: f64,
    effort: f64,
}

impl Reached {
    const LOST: Self = Self {
        settling: f64::INFINITY,
        overshoot: f64::INFINITY,
        left: f64::INFINITY,
        moves: f64::INFINITY,
        rms: f64::INFINITY,
        largest: f64::INFINITY,
        effort: f64::INFINITY,
    };

    fn of(run: &LinkRun, amplitude: f64) -> Self {
        let steps: Vec<Metrics> = (1..STEPS)
            .filter_map(|step| {
                let at = step * samples()..(step + 1) * samples();
                let angles: Vec<f64> = run.states[at.clone()].iter().map(|x| x[0]).collect();
                let volts = &run.voltages[at.clone()];
                Metrics::of(&angles, volts, reference(amplitude, at.start), DT, (-LIMIT, LIMIT))
            })
            .collect();
        let worst = |of: &dyn Fn(&Metrics) -> f64| steps.iter().map(of).fold(0.0, f64::max);
        Self {
            settling: worst(&|m| m.settling.unwrap_or(f64::INFINITY)),
            overshoot: worst(&|m| 100.0 * m.overshoot),
            left: worst(&|m| m.final_error.abs().to_degrees()),
            moves: worst(&|m| m.peak_to_peak.to_degrees()),
            rms: worst(&|m| m.rms_error.to_degrees()),
            largest: worst(&|m| m.largest_command),
            effort: worst(&|m| m.effort),
        }
    }

    fn cells(&self) -> Vec<String> {
        let settling = if self.settling.is_finite() { number(self.settling) } else { "not reached".into() };
        let rest = [self.overshoot, self.left, self.moves, self.rms, self.largest, self.effort];
        [settling].into_iter().chain(rest.map(number)).collect()
    }
}

/// θ and its error over the second and third step, every fifth sample, degrees.
fn curves(run: &LinkRun, amplitude: f64) -> [Vec<[f64; 2]>; 2] {
    let at = samples()..3 * samples();
    let thin = |value: &dyn Fn(usize) -> f64| -> Vec<[f64; 2]> {
        at.clone().step_by(5).map(|k| [k as f64 * DT, value(k).to_degrees()]).collect()
    };
    [thin(&|k| run.states[k][0]), thin(&|k| run.states[k][0] - reference(amplitude, k))]
}

/// What makes integral action hunt: the same law on the rig, and on a rig whose friction turns the hub alone, so that α̈
/// has it as −θ̈ does.
fn hunting(piece: &mut Piece, improved: &Model) -> Result<()> {
    let hub = RIG.hub.coulomb / RIG.hub.acceleration;
    let on_the_hub = RotaryFlexibleLink {
        link: VoltageBalance { coulomb: -hub * RIG.link.acceleration, ..RIG.link },
        ..RIG
    };
    let way = ways()
        .into_iter()
        .find(|w| w.observer.is_some_and(|(_, integral)| integral == Integral::Disturbance));
    let way = way.context("no way has integral action")?;
    let mut rows = Vec::new();
    for degrees in AMPLITUDES {
        let amplitude = f64::to_radians(degrees);
        let law = law(improved, &way, amplitude)?.context("the design is refused")?;
        let observer = way.observer.map(|(method, integral)| observer(&law, method, integral)).transpose()?;
        for (name, rig) in [("of the thesis", &RIG), ("friction on the hub alone", &on_the_hub)] {
            let reached = match run(rig, &law, observer.as_ref(), amplitude)? {
                Ok(run) => Reached::of(&run, amplitude),
                Err(_) => Reached::LOST,
            };
            rows.push([vec![name.to_owned(), format!("±{degrees}°")], reached.cells()].concat());
            if rig != &RIG {
                let mut check = |what: &str, value: f64| {
                    let name = format!("{}, ±{degrees}°, friction on the hub alone: {what}", way.name);
                    piece.checks.push(Check::new(name, value));
                };
                check("error left in degrees", reached.left);
                check("peak to peak at rest in degrees", reached.moves);
            }
        }
    }
    let mut headings = vec!["rig".to_owned(), "steps".to_owned()];
    headings.extend(piece.tables[1].headings[3..].iter().cloned());
    piece.tables.push(Table {
        caption: "Integral action on a rig whose friction also acts on the deflection, and on one where it does not.".into(),
        headings,
        rows,
    });
    Ok(())
}

fn story(answer: &Answer) -> Result<Piece> {
    let models = [&answer.nominal, &answer.calibrated, &answer.improved];
    let mut piece = Piece::new(
        Status::VirtualRig,
        "The model and the recordings of greybox demo, diagnosed; then one and the same design on the model as given, \
         with its parameters refitted, and with the physics that was found. Each law runs on the rig that made the \
         recordings, with its true friction and all else that the models lack, and is given the true state, so that \
         what differs comes from the model alone. Nothing is tuned: typical sizes by Bryson's rule, and λ = 16, \
         η/φ = 100 of the thesis. Both designs settle on the improved model, on steps of 40° and of 20°, and end nearer \
         than on the others. Friction that is fed forward at the hub makes the loop of the improved model unstable, and \
         the design is refused: it would hunt. The RMS error is mostly \
         the way there.",
    );
    piece.tables.push(Table {
        caption: "What the diagnosis found.".into(),
        headings: ["mechanism", "equation", "share of the residual", "confidence"]
            .map(str::to_owned)
            .to_vec(),
        rows: answer.found.clone(),
    });
    let mut rows = Vec::new();
    for way in ways() {
        for degrees in AMPLITUDES {
            let amplitude = f64::to_radians(degrees);
            let (mut angles, mut errors) = (Vec::new(), Vec::new());
            let mut reached = Vec::new();
            for (name, model) in MODELS.into_iter().zip(models) {
                let law = law(model, &way, amplitude).with_context(|| format!("{}, {name}", way.name))?;
                let head = [way.name.to_owned(), name.to_owned(), format!("±{degrees}°")].to_vec();
                let ran = match law {
                    Some(law) => {
                        let observer = way
                            .observer
                            .map(|(method, integral)| observer(&law, method, integral))
                            .transpose()?;
                        run(&RIG, &law, observer.as_ref(), amplitude)?
                            .map_err(|time| format!("leaves ±40° after {} s", number(time)))
                    }
                    None => Err("refused: unstable".to_owned()),
                };
                match ran {
                    Ok(run) => {
                        let this = Reached::of(&run, amplitude);
                        rows.push([head, this.cells()].concat());
                        let [angle, error] = curves(&run, amplitude);
                        angles.push(Series::new(name, Style::Line, angle));
                        errors.push(Series::new(name, Style::Line, error));
                        reached.push(this);
                    }
                    Err(lost) => {
                        rows.push([head, vec![lost], vec![String::new(); 6]].concat());
                        reached.push(Reached::LOST);
                    }
                }
            }
            judge(&mut piece, &way, degrees, &reached);
            if way.is_shown() {
                let square = (samples()..3 * samples()).step_by(5);
                let square = square.map(|k| [k as f64 * DT, reference(amplitude, k).to_degrees()]).collect();
                angles.insert(0, Series::new("reference", Style::Dashed, square));
                let zero = [1.0, 3.0].map(|t| [t * HOLD, 0.0]).to_vec();
                errors.insert(0, Series::new("", Style::Dashed, zero));
                let caption =
                    |what: &str| format!("{what}, {} designed on each model, ±{degrees}°.", way.name);
                let time = || Axis::linear("time in s");
                draw(&mut piece, &caption("Hub angle"), (time(), Axis::linear("θ in degrees")), angles)?;
                let near = Axis { range: Some((-4.0, 4.0)), ..Axis::linear("θ − reference in degrees") };
                draw(&mut piece, &caption("Tracking error"), (time(), near), errors)?;
            }
        }
    }
    piece.tables.push(Table {
        caption: "The worst of four steps from end to end.".into(),
        headings: [
            "design",
            "model",
            "steps",
            "settling (2 %) in s",
            "overshoot in %",
            "error left in degrees",
            "peak to peak at rest in degrees",
            "RMS error in degrees",
            "largest voltage in V",
            "∫ u² dt in V² s",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows,
    });
    hunting(&mut piece, &answer.improved)?;
    // Torque per volt of the data sheet: that of the nominal model, which holds it fixed.
    let value = |name: &str| -> Result<f64> {
        let model = &answer.improved;
        Ok(model.parameters[model.parameter(name).with_context(|| format!("no parameter {name}"))?].value)
    };
    let torque = value("eta")? * value("Kg")? * value("kt")? / value("Rm")?;
    piece
        .checks
        .push(Check::new("friction found over that of the rig", value("fc")? / (RIG.hub.coulomb * torque)));
    Ok(piece)
}

/// Steps of so many degrees to either side are small.
const SMALL: f64 = 10.0;

/// What must stay so, for one way and one amplitude.
fn judge(piece: &mut Piece, way: &Way, degrees: f64, reached: &[Reached]) {
    let [nominal, calibrated, improved] = reached else { return };
    let mut check = |what: &str, value: f64| {
        piece.checks.push(Check::new(format!("{}, ±{degrees}°: {what}", way.name), value));
    };
    if way.observer.is_some() {
        check("error left in degrees, improved", improved.left);
        check("peak to peak at rest in degrees, improved", improved.moves);
        // With the disturbance as integral action it hunts, and does not settle.
        if degrees > SMALL && way.observer.is_some_and(|(_, integral)| integral != Integral::Disturbance) {
            check("settling in s, improved", improved.settling);
        }
        return;
    }
    if !way.is_shown() {
        check("refused or lost, improved", f64::from(u8::from(improved.left.is_infinite())));
        return;
    }
    check("error left in degrees, improved", improved.left);
    check(
        "error left, improved over the better of the others",
        improved.left / nominal.left.min(calibrated.left),
    );
    check(
        "RMS error, improved over the better of the others",
        improved.rms / nominal.rms.min(calibrated.rms),
    );
    // Small steps end where friction holds; whether they settle turns on a tenth of a degree.
    if degrees > SMALL {
        check("settling in s, improved", improved.settling);
        check("settling, improved over the faster of the others", {
            let others = nominal.settling.min(calibrated.settling);
            if others.is_finite() { improved.settling / others } else { 0.0 }
        });
    }
    check("∫ u² dt, improved over calibrated", improved.effort / calibrated.effort);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refitted_parameter_is_read_in_its_unit() {
        let text = "[states]\nx = { unit = \"m\" }\n[parameters]\nl = { value = 2, unit = \"mm\" }\nc = { value = 1, unit = \"1/s\" }\n\
                    [equations]\nx = \"x' + c*(x - l) = 0\"\n";
        let nominal = Model::from_toml(text, "x.toml").unwrap();
        let reported = |value: f64| Parameter {
            nominal: value,
            value,
            ci95: None,
            unit: None,
            fixed: false,
            calibrated: Some(value),
            calibrated_ci95: None,
        };
        let mut report =
            Ordered::from_iter([("l".to_owned(), reported(3.0)), ("c".to_owned(), reported(0.5))]);
        let model = refitted(&nominal, &report).unwrap();
        let values: Vec<f64> = model.parameters.iter().map(|p| p.value).collect();
        assert!((values[0] - 0.003).abs() < 1e-12 && (values[1] - 0.5).abs() < 1e-12, "{values:?}");
        report["c"].calibrated = None;
        let error = refitted(&nominal, &report).unwrap_err().to_string();
        assert!(error.contains("`c`"), "{error}");
    }

    /// Without the diagnosis, which takes a minute: the laws of the nominal model on the rig.
    #[test]
    fn the_nominal_model_leaves_an_error_on_the_rig() {
        let text = include_str!("../../../crates/cli/demo/rotary_link.toml");
        let model = Model::from_toml(text, "rotary_link.toml").unwrap();
        let amplitude = 20f64.to_radians();
        for way in ways() {
            let law = law(&model, &way, amplitude).unwrap().unwrap();
            let reached = Reached::of(&run(&RIG, &law, None, amplitude).unwrap().unwrap(), amplitude);
            assert!(reached.settling.is_infinite() && (1.0..2.5).contains(&reached.left), "{}", way.name);
            assert!(reached.largest <= LIMIT && reached.rms < 15.0, "{}", way.name);
        }
    }
}
