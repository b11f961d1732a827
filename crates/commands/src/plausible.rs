//! Does the model as given move as the machine does? Tells a wrong sign, unit or channel before a diagnosis looks for
//! physics behind it.

use std::sync::Arc;

use greybox_calibrate::{Data, FreeRun, Setup, input_noise};
use greybox_model::{Measurement, Model, Unit};
use greybox_recording::{Channel, Finding, Recording, Severity};
use greybox_report::format;

use crate::simulate::settled_run;

/// Rows of a recording that are simulated.
const ROWS: usize = 20_000;

/// Motions are compared over a stretch of one part: over the whole, an axis that integrates drifts.
const PARTS: usize = 50;

/// Least correlation of two motions whose sizes can be compared.
const ALIKE: f64 = 0.8;

/// By this factor, a motion is too large or too small for parameters that are known roughly.
const FAR: f64 = 5.0;

/// A simulation that goes this many times beyond the range of the measurement has left it.
const BEYOND: f64 = 100.0;

/// A channel that moves by fewer times its noise tells nothing.
const STILL: f64 = 5.0;

/// What a channel without a unit is often in, where the model has another.
const OFTEN: [&str; 12] = ["deg", "rev", "mrad", "deg/s", "rpm", "rps", "mm", "cm", "mm/s", "mV", "mA", "kN"];

/// What a free run of the model as given tells of its signs and units; nothing where there is none.
pub(crate) fn findings(model: &Model, recording: &Recording) -> Vec<Finding> {
    let run = || {
        let data = Arc::new(Data::new(model, &[beginning(recording)?]).ok()?);
        let setup = Setup::new(model, data, Vec::new()).ok()?;
        let run = settled_run(&setup, &setup.values());
        Some((setup, run))
    };
    let Some((setup, run)) = run() else { return Vec::new() };
    let data = &setup.data;
    let moving: Vec<usize> =
        (0..data.channels.len()).filter(|&c| data.spread[c] > STILL * data.sigma[c]).collect();
    if !moving.is_empty() && (run.diverged || moving.iter().any(|&c| leaves(data, &run, c))) {
        return vec![
            Finding::new(
                Severity::Warning,
                "nominal_diverges",
                "Run on this recording, the model as given leaves the measurements far behind.",
            )
            .mend(
                "Look at its signs first (of the input, of damping, stiffness and feedback), then at units and values \
                 of its parameters.",
            ),
        ];
    }
    let compared = moving.into_iter().filter_map(|c| {
        let measurement = &model.measurements[c];
        let stated = recording.channel(&measurement.channel)?.unit.is_some();
        sized(measurement, stated, motion(data, &run, c)?)
    });
    let mut found: Vec<Finding> = compared.collect();
    if !run.diverged {
        found.extend(input_noise::findings(&setup, &setup.values(), &run, false));
    }
    found
}

/// The first rows of a recording.
fn beginning(recording: &Recording) -> Option<Recording> {
    let rows = recording.time.len().min(ROWS);
    let cut = |channel: &Channel| Channel { values: channel.values[..rows].to_vec(), ..channel.clone() };
    let channels = recording.channels.iter().map(cut).collect();
    Recording::from_columns(&recording.name, recording.time[..rows].to_vec(), channels).ok()
}

/// Measured and simulated samples of a channel, piece by piece, SI.
fn pairs<'a>(data: &'a Data, run: &'a FreeRun, c: usize) -> impl Iterator<Item = (&'a [f64], &'a [f64])> {
    data.pieces.iter().zip(&run.y).map(move |(piece, y)| {
        let simulated = &y[c * piece.len..(c + 1) * piece.len];
        (&piece.measured[c][..], simulated)
    })
}

/// Whether the simulation of a channel goes far beyond what was measured.
fn leaves(data: &Data, run: &FreeRun, c: usize) -> bool {
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) = values
            .filter(|v| !v.is_nan())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        high - low
    };
    let measured = range(&mut pairs(data, run, c).flat_map(|(m, _)| m.iter().copied()));
    let simulated = range(&mut pairs(data, run, c).flat_map(|(_, s)| s.iter().copied()));
    simulated > BEYOND * measured
}

/// How large the measured motion is beside the simulated one, and negative where it goes the other way; `None` where
/// the two are not alike.
fn motion(data: &Data, run: &FreeRun, c: usize) -> Option<f64> {
    let (mut mm, mut ms, mut ss) = (0.0, 0.0, 0.0);
    for (measured, simulated) in pairs(data, run, c) {
        let lag = (measured.len() / PARTS).max(1);
        let moved = measured.iter().zip(&measured[lag..]).zip(simulated.iter().zip(&simulated[lag..]));
        for ((m0, m1), (s0, s1)) in moved {
            let (m, s) = (m1 - m0, s1 - s0);
            if m.is_finite() && s.is_finite() {
                mm += m * m;
                ms += m * s;
                ss += s * s;
            }
        }
    }
    let correlation = ms / (mm * ss).sqrt();
    let ratio = (mm / ss).sqrt().copysign(ms);
    (correlation.abs() > ALIKE && ratio.is_finite()).then_some(ratio)
}

/// What is to be said of a motion `ratio` times as large as the model's.
fn sized(measurement: &Measurement, stated: bool, ratio: f64) -> Option<Finding> {
    let times = format::significant(ratio.abs(), 2);
    let on = |code, message: String, mend: String| {
        Finding::new(Severity::Warning, code, message).on(&measurement.channel).mend(mend).value(ratio, None)
    };
    if ratio < 0.0 {
        return Some(on(
            "nominal_sign",
            "It moves against what the model as given says on this recording.".to_owned(),
            "Look at the sign of the input and of this measurement, in the model and at the machine."
                .to_owned(),
        ));
    }
    if (1.0 / FAR..FAR).contains(&ratio) {
        return None;
    }
    let message = format!("It moves {times} times as far as the model as given says on this recording.");
    let other = "a gear or a gain that the model lacks between what it simulates and what is measured, and the values \
                 of its parameters";
    let unit = &measurement.unit;
    let mend = match often(unit, ratio).filter(|_| !stated) {
        Some(likely) => format!(
            "The channel states no unit and is taken as {}: is it in {likely}? State it: in the header, \
             `--map \"{1}={1} [{likely}]\"`, or in the model. Else look at {other}.",
            unit.text, measurement.channel
        ),
        None => format!("Look at its unit, at {other}."),
    };
    Some(on("nominal_size", message, mend))
}

/// The unit in which a channel that is taken as `unit` would be as large as the model says, within a factor of two.
fn often(unit: &Unit, ratio: f64) -> Option<&'static str> {
    let off = |text: &str| {
        let other = Unit::parse(text).ok().filter(|other| other.dimension.same(&unit.dimension))?;
        Some((other.factor * ratio / unit.factor).ln().abs())
    };
    let near = OFTEN.into_iter().filter_map(|text| Some((text, off(text)?)));
    near.filter(|(_, off)| *off < 2f64.ln()).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(text, _)| text)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODEL: &str = r#"
[inputs]
u = { unit = "V" }
[states]
theta = { unit = "rad" }
[parameters]
J = { value = 0.02, unit = "kg m^2" }
b = { value = 0.1, unit = "N m s/rad" }
kt = { value = 0.5, unit = "N m/V" }
[equations]
shaft = "J*theta'' + b*theta' = kt*u"
"#;

    /// J θ″ + b θ′ = kt u with an inertia 30 % off the model's, logged as `factor` θ without a unit.
    fn logged(factor: f64) -> Recording {
        let (dt, fine) = (0.01, 20);
        let (mut theta, mut omega) = (0.0, 0.0);
        let (mut time, mut input, mut angle) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..2000 {
            let t = f64::from(k) * dt;
            let u = |t: f64| (2.0 * t).sin() + 0.5 * (9.0 * t).cos();
            time.push(t);
            input.push(u(t));
            angle.push(factor * theta);
            for i in 0..fine {
                let h = dt / f64::from(fine);
                omega += h * (0.5 * u(t + h * f64::from(i)) - 0.1 * omega) / 0.026;
                theta += h * omega;
            }
        }
        let channel = |name: &str, values| Channel { name: name.to_owned(), unit: None, values };
        Recording::from_columns("run.csv", time, vec![channel("u", input), channel("theta", angle)]).unwrap()
    }

    fn told(text: &str, factor: f64) -> Vec<Finding> {
        findings(&Model::from_toml(text, "m.toml").unwrap(), &logged(factor))
    }

    #[test]
    fn a_model_with_roughly_known_parameters_is_left_in_peace() {
        let found = told(MODEL, 1.0);
        assert!(found.is_empty(), "{found:?}");
    }

    #[test]
    fn degrees_taken_as_radians_are_told() {
        let found = told(MODEL, 1f64.to_degrees());
        assert_eq!(found[0].code, "nominal_size");
        assert!(found[0].mend.as_deref().unwrap().contains("[deg]"), "{found:?}");
        assert_eq!(found.len(), 1);
    }

    #[test]
    fn a_gear_that_the_model_lacks_is_no_unit() {
        let found = told(MODEL, 20.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_size"));
        assert!(found[0].mend.as_deref().unwrap().contains("a gear"), "{found:?}");
    }

    #[test]
    fn a_turned_sign_is_told() {
        let found = told(MODEL, -1.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_sign"));
    }

    #[test]
    fn a_model_that_runs_away_is_told() {
        let wrong = MODEL.replace("+ b*theta'", "- b*theta'");
        let found = told(&wrong, 1.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_diverges"));
    }
}
