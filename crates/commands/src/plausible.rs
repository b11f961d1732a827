//! Does the model as given move as the machine does? Tells a wrong sign, unit or channel before a diagnosis looks for
//! physics behind it.

use std::sync::Arc;

use greybox_calibrate::{Data, FreeRun, Setup, input_noise};
use greybox_model::{Expr, Measurement, Model, Unit};
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
const MANY_TIMES: f64 = 5.0;

/// A simulation that goes this many times beyond the range of the measurement has left it.
const BEYOND: f64 = 100.0;

/// A channel that moves by fewer times its noise tells nothing.
const STILL: f64 = 5.0;

/// A simulation this far from the measurements, RMS over the RMS of their motion, is worse than none.
const POOR: f64 = 1.0;

/// Below this it follows them, and what it takes of the error of the model as given makes it clearly the better one.
const FOLLOWS: f64 = 0.7;
const CLEARLY: f64 = 0.5;

/// Errors within this factor of the least are as good as it: the signs of an input and of its gain are one.
const AS_GOOD: f64 = 1.02;

/// Most signs that are tried, one after the other.
const MOST_SIGNS: usize = 50;

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
                "Run on this recording, the model as given diverges from the measurements.",
            )
            .help(match turned(&setup, &moving, f64::INFINITY) {
                Some(turned) => turned.help(""),
                None => "Look at units and values of its parameters: with no single sign reversed does the simulation \
                         follow the recording."
                    .to_owned(),
            }),
        ];
    }
    let error = misfit(data, &run, &moving);
    let mut found: Vec<Finding> = moving
        .iter()
        .filter_map(|&c| {
            let measurement = &model.measurements[c];
            let stated = recording.channel(&measurement.channel)?.unit.is_some();
            sized(measurement, stated, motion(data, &run, c)?)
        })
        .collect();
    // A motion that grows looks too large, whatever the units.
    let poor = error > POOR || found.iter().any(|f| f.code == SIGN);
    let Some(turned) = poor.then(|| turned(&setup, &moving, error)).flatten() else {
        found.extend(input_noise::findings(&setup, &setup.values(), &run, false));
        return found;
    };
    if let Some(finding) = found.iter_mut().find(|f| f.code == SIGN) {
        finding.help = Some(turned.help(" or of this measurement"));
        return found;
    }
    vec![
        Finding::new(
            Severity::Warning,
            SIGN,
            format!(
                "Run on this recording, the model as given is far from the measurements (nrmse {}).",
                format::percent(error)
            ),
        )
        .help(turned.help("")),
    ]
}

/// Code of the findings about signs.
const SIGN: &str = "nominal_sign";

/// What fits clearly better with its sign reversed.
#[derive(Debug)]
struct Turned {
    /// Parameters and inputs, as sentences name them; any one of them.
    names: Vec<String>,
    /// The error with the best of them reversed.
    error: f64,
}

impl Turned {
    /// What to do, with `besides` as one more thing that may be reversed.
    fn help(&self, besides: &str) -> String {
        let names = self.names.join(" or of ");
        format!(
            "Reverse the sign of {names}{besides}, in its value or where it stands in the equations: so the simulation follows \
             the recording (nrmse {}).",
            format::percent(self.error)
        )
    }
}

/// Tries the sign of every input and of every parameter that is no inertia, one at a time. `None` where no simulation
/// follows the measurements, or none is clearly better than the model as given, which has this `error`.
fn turned(setup: &Setup, moving: &[usize], error: f64) -> Option<Turned> {
    let (model, values) = (&setup.model, setup.values());
    let inertias = inertias(model);
    let parameters = model.parameters.iter().enumerate();
    let parameters =
        parameters.filter(|(_, p)| p.value != 0.0 && !inertias.contains(&p.name)).map(|(i, p)| {
            let mut values = values.clone();
            values[i] = -values[i];
            (format!("`{}`", p.name), settled_run(setup, &values))
        });
    let inputs = model.inputs.iter().filter_map(|input| {
        let mut model = model.clone();
        for primes in 0..=2 {
            model.replace(&input.name, primes, &-Expr::prime(&input.name, primes));
        }
        let setup = setup.with_model(model, Vec::new()).ok()?;
        Some((format!("the input `{}`", input.name), settled_run(&setup, &values)))
    });
    let tried: Vec<(String, f64)> = inputs
        .chain(parameters)
        .take(MOST_SIGNS)
        .map(|(name, run)| (name, misfit(&setup.data, &run, moving)))
        .collect();
    let least = tried.iter().map(|t| t.1).fold(f64::INFINITY, f64::min);
    if !(least < FOLLOWS && least < CLEARLY * error) {
        return None;
    }
    let names = tried.into_iter().filter(|t| t.1 <= AS_GOOD * least).map(|t| t.0).collect();
    Some(Turned { names, error: least })
}

/// The parameters in the factors of the highest derivatives: reversed with one of them, all the rest of an equation would be.
fn inertias(model: &Model) -> Vec<String> {
    let factors = model.equations.iter().flat_map(|equation| {
        let residual = equation.residual();
        model.states.iter().map(move |state| residual.derivative(&state.name, state.order.min(255) as u8))
    });
    factors.flat_map(|factor| factor.variables()).map(|(name, _)| name.to_string()).collect()
}

/// Error of a run: RMS over these channels of the RMS error over the RMS of the motion; infinite where the run diverges.
fn misfit(data: &Data, run: &FreeRun, channels: &[usize]) -> f64 {
    if run.diverged {
        return f64::INFINITY;
    }
    let of = |&c: &usize| {
        let (mut sum, mut count) = (0.0, 0usize);
        for (m, s) in pairs(data, run, c).flat_map(|(m, s)| m.iter().zip(s)).filter(|(m, _)| !m.is_nan()) {
            sum += (m - s) * (m - s);
            count += 1;
        }
        sum / count.max(1) as f64 / (data.spread[c] * data.spread[c])
    };
    let mean = channels.iter().map(of).sum::<f64>() / channels.len().max(1) as f64;
    if mean.is_nan() { f64::INFINITY } else { mean.sqrt() }
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
    let on = |code, message: String, help: String| {
        Finding::new(Severity::Warning, code, message).on(&measurement.channel).help(help).value(ratio, None)
    };
    if ratio < 0.0 {
        return Some(on(
            SIGN,
            "It moves against what the model as given says on this recording.".to_owned(),
            "Look at the sign of the input and of this measurement, in the model and at the machine."
                .to_owned(),
        ));
    }
    if (1.0 / MANY_TIMES..MANY_TIMES).contains(&ratio) {
        return None;
    }
    let message = format!("It moves {times} times as far as the model as given says on this recording.");
    let other = "a gear or a gain that the model lacks between what it simulates and what is measured, and the values \
                 of its parameters";
    let unit = &measurement.unit;
    let help = match often(unit, ratio).filter(|_| !stated) {
        Some(likely) => format!(
            "The channel states no unit and is taken as {}: is it in {likely}? State it: in the header, \
             `--map \"{1}={1} [{likely}]\"`, or in the model. Else look at {other}.",
            unit.text, measurement.channel
        ),
        None => format!("Look at its unit, at {other}."),
    };
    Some(on("nominal_size", message, help))
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

    fn reported(text: &str, factor: f64) -> Vec<Finding> {
        findings(&Model::from_toml(text, "m.toml").unwrap(), &logged(factor))
    }

    #[test]
    fn a_model_with_roughly_known_parameters_is_left_in_peace() {
        let found = reported(MODEL, 1.0);
        assert!(found.is_empty(), "{found:?}");
    }

    #[test]
    fn degrees_taken_as_radians_are_told() {
        let found = reported(MODEL, 1f64.to_degrees());
        assert_eq!(found[0].code, "nominal_size");
        assert!(found[0].help.as_deref().unwrap().contains("[deg]"), "{found:?}");
        assert_eq!(found.len(), 1);
    }

    #[test]
    fn a_gear_that_the_model_lacks_is_no_unit() {
        let found = reported(MODEL, 20.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_size"));
        assert!(found[0].help.as_deref().unwrap().contains("a gear"), "{found:?}");
    }

    fn help(found: &[Finding]) -> &str {
        found[0].help.as_deref().unwrap()
    }

    #[test]
    fn a_turned_sign_is_told() {
        let found = reported(MODEL, -1.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_sign"));
        assert!(help(&found).contains("the input `u` or of `kt` or of this measurement"), "{found:?}");
    }

    #[test]
    fn a_turned_damping_is_told_by_its_name() {
        let wrong = MODEL.replace("+ b*theta'", "- b*theta'");
        let found = reported(&wrong, 1.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_diverges"));
        assert!(help(&found).starts_with("Reverse the sign of `b`, in its value"), "{found:?}");
        assert!(help(&found).contains("(nrmse"), "{found:?}");
        // As a value too.
        let found = reported(&MODEL.replace("value = 0.1,", "value = -0.1,"), 1.0);
        assert!(help(&found).starts_with("Reverse the sign of `b`, in its value"), "{found:?}");
    }

    #[test]
    fn a_turned_damping_is_told_before_it_runs_away() {
        let wrong = Model::from_toml(&MODEL.replace("+ b*theta'", "- b*theta'"), "m.toml").unwrap();
        for rows in [80, 120] {
            let mut recording = logged(1.0);
            recording.time.truncate(rows);
            recording.channels.iter_mut().for_each(|channel| channel.values.truncate(rows));
            let short = Recording::from_columns("run.csv", recording.time, recording.channels).unwrap();
            let found = findings(&wrong, &short);
            assert_eq!((found.len(), found[0].code), (1, "nominal_sign"), "{found:?}");
            assert!(help(&found).starts_with("Reverse the sign of `b`, in its value"), "{found:?}");
        }
    }

    #[test]
    fn a_wrong_inertia_is_told_without_a_word_on_signs() {
        for inertia in ["2e-6", "200"] {
            let wrong = MODEL.replace("value = 0.02,", &format!("value = {inertia},"));
            for finding in reported(&wrong, 1.0) {
                let help = finding.help.as_deref().unwrap();
                assert!(!help.contains("Reverse the sign"), "{inertia}: {finding:?}");
                assert_ne!(finding.code, "nominal_sign", "{inertia}");
            }
        }
        // So small that the motion would be hundreds of times as large.
        let free = MODEL.replace(" + b*theta'", "").replace("value = 0.02,", "value = 2e-5,");
        let free = free.replace("b = { value = 0.1, unit = \"N m s/rad\" }\n", "");
        let found = reported(&free, 1.0);
        assert_eq!((found.len(), found[0].code), (1, "nominal_diverges"));
        assert!(help(&found).starts_with("Look at units and values"), "{found:?}");
    }

    #[test]
    fn inertias_are_what_multiplies_the_highest_derivatives() {
        let text = "[states]\nx = {}\nq = {}\n[parameters]\nm = { value = 1 }\nl = { value = 1 }\nc = { value = 1 }\n\
                    [equations]\na = \"m*l^2*x'' + c*x' = 0\"\nb = \"q' + c*q + m*l*x = 0\"\n";
        let mut found = inertias(&Model::from_toml(text, "m.toml").unwrap());
        found.sort();
        found.dedup();
        assert_eq!(found, ["l", "m"]);
    }
}
