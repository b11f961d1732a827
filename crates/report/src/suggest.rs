//! The experiment that separates an explanation from its alternatives: which input, how large, at which
//! frequencies, over which part of the state space.
//!
//! Every number is read off the recordings ([`Reach`]) or off the law that was found; a figure that neither
//! gives is left out. No experiment asks for more than the input reached in the recordings, which is known to be
//! possible, unless the model states that the actuator can do more.

use std::f64::consts::PI;

use greybox_diagnose::library::Excitation;

use crate::contract::{Experiment, Interval, Location, Ordered};
use crate::{expression, format};

/// How far beyond the present recordings an experiment goes, where the actuator can.
const LOUDER: f64 = 1.5;

/// An amplitude that is larger by less than this is the same.
const MORE: f64 = 1.02;

/// What the present recordings reach.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reach {
    /// Each input of the model with its unit, and what it reached in that unit.
    pub inputs: Vec<InputRange>,
    /// Range of each simulated coordinate, in the units of [`Location::region`].
    pub coordinates: Ordered<[f64; 2]>,
    /// Sample interval, s.
    pub dt: f64,
}

impl Reach {
    /// The input of this name, else the only one.
    fn input(&self, name: Option<&str>) -> Option<&InputRange> {
        let only = || self.inputs.first().filter(|_| self.inputs.len() == 1);
        self.inputs.iter().find(|i| Some(i.name.as_str()) == name).or_else(only)
    }
}

/// What the recordings hold of one input.
#[derive(Debug, Clone, PartialEq)]
pub struct InputRange {
    /// Name in the model.
    pub name: String,
    /// Its unit as text.
    pub unit: String,
    /// Root mean square.
    pub rms: f64,
    /// Lowest and highest value.
    pub reached: [f64; 2],
    /// Lowest and highest value that the model says the actuator can make.
    pub stated: Option<[f64; 2]>,
}

impl InputRange {
    fn is_negative(&self) -> bool {
        self.reached[1] <= 0.0 && self.reached[0] < 0.0 && self.stated.is_none_or(|s| s[1] <= 0.0)
    }

    /// The same with the sign turned.
    fn turned(&self) -> InputRange {
        let turn = |[low, high]: [f64; 2]| [-high, -low];
        InputRange { reached: turn(self.reached), stated: self.stated.map(turn), ..self.clone() }
    }

    /// Where an experiment may go.
    fn allowed(&self) -> [f64; 2] {
        self.stated.unwrap_or(self.reached)
    }

    /// Largest magnitude of an experiment, and of the recordings as far as it is allowed.
    fn largest(&self) -> (f64, f64) {
        let size = |[low, high]: [f64; 2]| low.abs().max(high.abs());
        let top = size(self.allowed());
        (top, size(self.reached).min(top))
    }
}

/// What is known of the mechanism.
#[derive(Clone, Copy)]
pub struct Subject<'a> {
    /// What its own law asks for.
    pub own: Drive,
    /// What the law of the alternative asks for that the experiment is about.
    pub alternative: Drive,
    /// The input that reaches it, where one is known.
    pub input: Option<&'a str>,
    /// Where it acts.
    pub location: &'a Location,
    /// The kinds' own words on the recording that separates them.
    pub separate: &'a str,
}

/// How an experiment drives the machine. `None`: as the recordings do, at the frequencies where the mechanism acts.
type Drive = Option<Excitation<f64>>;

/// The part of an experiment that is about the input.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Amplitude {
    /// From and to, in the input's unit.
    range: [f64; 2],
    /// It would go further if the input could.
    clipped: bool,
}

/// How far an experiment drives the input.
fn amplitude(drive: Drive, input: &InputRange) -> Amplitude {
    if input.is_negative() {
        let Amplitude { range: [low, high], clipped } = amplitude(drive, &input.turned());
        return Amplitude { range: [-low, -high], clipped };
    }
    let (top, largest) = input.largest();
    let louder = (LOUDER * largest).min(top);
    let more = louder > MORE * largest;
    let (range, clipped) = match drive {
        Some(Excitation::Slow) => ([0.0, largest], false),
        Some(Excitation::Wide) if more => ([largest, louder], false),
        Some(Excitation::Wide) => ([0.0, largest], true),
        Some(Excitation::Loud) if more => ([largest, louder], false),
        Some(Excitation::Loud) => ([0.5 * largest, largest], true),
        Some(Excitation::Around(_)) | None => ([input.rms.min(largest), largest], false),
        Some(Excitation::Silent) => ([0.0, 0.0], false),
        Some(Excitation::Again) => ([largest, largest], false),
        Some(Excitation::Ramp(end)) => ([0.0, end.min(top)], end > top),
        Some(Excitation::Beyond(start)) => {
            let wanted = LOUDER * start.max(largest);
            let end = wanted.min(top);
            let start = if start < end { start } else { 0.5 * end };
            ([start, end], wanted > MORE * end)
        }
    };
    // An input that is never zero stays where it can be.
    let least = input.allowed()[0].max(0.0);
    Amplitude { range: range.map(|v| v.max(least)), clipped }
}

/// The experiment for a mechanism.
pub fn experiment(subject: &Subject<'_>, reach: &Reach) -> Experiment {
    planned(subject.alternative.or(subject.own), subject, reach)
}

/// The experiment for a remainder without a name: the recordings again, louder.
pub fn for_remainder(location: &Location, input: Option<&str>, reach: &Reach, shape: &str) -> Experiment {
    // Nobody sweeps time.
    let (drive, ask) = match shape.ends_with("with time") {
        true => (
            Some(Excitation::Again),
            "the same short experiment at the beginning and at the end of a long run",
        ),
        false => {
            (Some(Excitation::Loud), "slow sweeps over the whole range of that variable, at two amplitudes")
        }
    };
    let separate = format!("the residual looks like {shape}: {ask}");
    let subject = Subject { own: drive, alternative: drive, input, location, separate: &separate };
    planned(drive, &subject, reach)
}

fn planned(drive: Drive, subject: &Subject<'_>, reach: &Reach) -> Experiment {
    let input = reach.input(subject.input);
    let amplitude = input.map(|input| amplitude(drive, input));
    // Time is not for the experimenter to pass through; with the input at zero nothing else is either.
    let region = subject
        .location
        .region
        .iter()
        .next()
        .filter(|(name, _)| *name != "t" && drive != Some(Excitation::Silent));
    let band = match drive {
        Some(Excitation::Slow) => slow_band(region, reach),
        Some(Excitation::Around(f)) => decade(f, reach),
        Some(Excitation::Loud) | None => subject.location.band_hz.map(|b| [b.low, b.high]),
        Some(Excitation::Wide)
        | Some(Excitation::Silent)
        | Some(Excitation::Again)
        | Some(Excitation::Ramp(_))
        | Some(Excitation::Beyond(_)) => None,
    };
    let mut found = Experiment {
        text: String::new(),
        input: input.map(|i| i.name.clone()),
        amplitude: amplitude.and_then(|a| {
            let [from, to] = a.range;
            interval([from.min(to), from.max(to)])
        }),
        band_hz: band.and_then(interval),
        variable: region.map(|(name, _)| name.clone()),
        range: region.map(|(_, range)| *range),
    };
    let unit = region.and_then(|(name, _)| subject.location.region_units.get(name));
    let driven = input.zip(amplitude).filter(|_| found.amplitude.is_some());
    found.text = words(drive, &found, driven, unit.map_or("", String::as_str), subject.separate);
    found
}

fn interval([low, high]: [f64; 2]) -> Option<Interval> {
    (low.is_finite() && high.is_finite() && low <= high).then(|| Interval::new(low, high))
}

/// Up to where a sine over the present range would leave the region of rates: a sine of amplitude A and
/// frequency f has the largest rate 2π f A. Nothing without such a region.
fn slow_band(region: Option<(&String, &[Option<f64>; 2])>, reach: &Reach) -> Option<[f64; 2]> {
    let (name, [low, high]) = region?;
    let range = reach.coordinates.get(name.strip_suffix('\'')?)?;
    let rate = match (low, high) {
        (Some(low), Some(high)) => low.abs().max(high.abs()),
        _ => return None,
    };
    let top = rate / (PI * (range[1] - range[0]));
    (top > 0.0).then_some([0.0, top])
}

/// The decade around a frequency, as far as the sample interval shows it.
fn decade(frequency: f64, reach: &Reach) -> Option<[f64; 2]> {
    let half = 10f64.sqrt();
    let nyquist = 0.5 / reach.dt;
    let band = [frequency / half, (frequency * half).min(nyquist)];
    (band[0] < band[1]).then_some(band)
}

/// `Drive u slowly, 0.05 … 0.3 Hz, up to 2 V, with θ′ from −0.2 to 0.2; then …`.
fn words(
    drive: Drive,
    e: &Experiment,
    driven: Option<(&InputRange, Amplitude)>,
    unit: &str,
    separate: &str,
) -> String {
    let mut text = String::new();
    if let Some((input, Amplitude { range: [low, high], clipped })) = driven {
        let name = expression::text(&input.name);
        let of = format::unit(&input.unit);
        let space = if of.is_empty() { "" } else { " " };
        let size = |v: f64| format!("{}{space}{of}", format::plain(v));
        let back = if input.is_negative() { -input.allowed()[1] } else { input.allowed()[0] };
        let (from, to) = (size(low), size(high));
        text = match drive {
            Some(Excitation::Slow) => format!("drive {name} slowly, up to {to} as now"),
            Some(Excitation::Wide) if clipped => format!("drive {name} slowly, up to {to}"),
            Some(Excitation::Wide) => format!("drive {name} slowly, from {from} as now up to {to}"),
            Some(Excitation::Loud) if clipped => format!("drive {name} at up to {from} and at up to {to}"),
            Some(Excitation::Loud) => format!("drive {name} as now, {from}, and at up to {to}"),
            Some(Excitation::Around(_)) => format!("sweep {name} as a sine of {from} to {to}"),
            None => format!("drive {name} with {from} to {to}"),
            Some(Excitation::Silent) if low == 0.0 => format!("record with {name} at zero"),
            Some(Excitation::Silent) => format!("record with {name} held at {from}"),
            Some(Excitation::Again) => format!("record the same again, {name} up to {to}"),
            // To the other side only as far as the input goes there.
            Some(Excitation::Ramp(_)) if back <= -high.abs() => {
                format!("ramp {name} slowly between {} and {to}", size(-high))
            }
            Some(Excitation::Ramp(_)) if back < 0.0 => {
                format!("ramp {name} slowly between {} and {to}", size(back))
            }
            Some(Excitation::Ramp(_)) => format!("ramp {name} slowly between {from} and {to}"),
            Some(Excitation::Beyond(_)) => format!("step {name} from {from} up to {to}"),
        };
        if clipped {
            text.push_str(match input.stated {
                Some(_) => ", the most that the model states for it",
                None => ", the most that these recordings reach",
            });
        }
        if let Some(band) = e.band_hz {
            let (low, high) = (format::plain(band.low), format::plain(band.high));
            text.push_str(&match band.low > 0.0 {
                true => format!(", {low} to {high} Hz"),
                false => format!(", below {high} Hz"),
            });
        }
        if let (Some(variable), Some(range)) = (&e.variable, e.range)
            && !matches!(drive, Some(Excitation::Silent | Excitation::Ramp(_) | Excitation::Beyond(_)))
            && let Some(condition) = crate::sentence::condition(variable, range, unit)
        {
            let further = drive == Some(Excitation::Wide) && driven.is_some_and(|(_, d)| !d.clipped);
            let through = if further { "beyond" } else { "through" };
            text.push_str(&format!(", {through} {condition}"));
        }
    }
    match (text.is_empty(), separate.is_empty()) {
        (false, false) => format!("{text}: {}", separate.trim_end_matches('.')),
        (true, _) => separate.trim_end_matches('.').to_owned(),
        (_, true) => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reach() -> Reach {
        Reach {
            inputs: vec![InputRange {
                name: "v".into(),
                unit: "V".into(),
                rms: 1.0,
                reached: [-2.0, 1.5],
                stated: Some([-10.0, 10.0]),
            }],
            coordinates: Ordered::from_iter([("theta".to_owned(), [-0.5, 0.5])]),
            dt: 0.01,
        }
    }

    fn ask(kind: &str, region: &[(&str, [Option<f64>; 2])], values: &[(&str, f64)]) -> Experiment {
        ask_of(&reach(), kind, region, values)
    }

    /// The same where the recordings reach `reached` and the model states `stated`.
    fn ask_within(
        reached: [f64; 2],
        stated: Option<[f64; 2]>,
        kind: &str,
        values: &[(&str, f64)],
    ) -> (Option<[f64; 2]>, String) {
        let mut reach = reach();
        reach.inputs[0] = InputRange { reached, stated, rms: 1.0, ..reach.inputs[0].clone() };
        let e = ask_of(&reach, kind, &[("theta", [Some(-1.0), Some(1.0)])], values);
        (e.amplitude.map(|a| [a.low, a.high]), e.text)
    }

    fn ask_of(
        reach: &Reach,
        kind: &str,
        region: &[(&str, [Option<f64>; 2])],
        values: &[(&str, f64)],
    ) -> Experiment {
        let region = region.iter().map(|(n, r)| ((*n).to_owned(), *r)).collect();
        let location = Location { region, band_hz: Some(Interval::new(0.5, 3.0)), ..Location::default() };
        let subject = Subject {
            own: drive(kind, values),
            alternative: None,
            input: Some("v"),
            location: &location,
            separate: "look.",
        };
        experiment(&subject, reach)
    }

    /// What a law of the library asks for.
    fn drive(kind: &str, values: &[(&str, f64)]) -> Drive {
        let library = greybox_diagnose::built_in().unwrap();
        let stated = library.iter().find(|m| m.kind == kind).and_then(|m| m.excitation.as_ref());
        stated?.evaluated(&|name| values.iter().find(|v| v.0 == name).map(|v| v.1))
    }

    fn near(found: Option<Interval>, [low, high]: [f64; 2]) {
        let found = found.unwrap();
        assert!((found.low - low).abs() < 1e-9 && (found.high - high).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn friction_asks_for_slow_motion_that_stays_in_its_region() {
        let e = ask("stribeck_friction", &[("theta'", [Some(-0.4), Some(0.4)])], &[]);
        near(e.amplitude, [0.0, 2.0]);
        // A sine of amplitude 0.5 and rate 0.4 has 0.4/(2 pi 0.5) Hz.
        near(e.band_hz, [0.0, 0.4 / PI]);
        assert_eq!((e.variable.as_deref(), e.range), (Some("theta'"), Some([Some(-0.4), Some(0.4)])));
        assert_eq!(e.text, "drive v slowly, up to 2 V as now, below 0.127 Hz, through |θ′| < 0.4: look");
        assert_eq!(
            ask("gravity", &[("theta", [Some(-1.0), Some(1.0)])], &[]).band_hz,
            None,
            "no rate, no band"
        );
    }

    #[test]
    fn a_delay_asks_for_its_corner_and_a_resonance_for_its_frequency() {
        let half = 10f64.sqrt();
        let corner = 1.0 / (2.0 * PI * 0.05);
        near(ask("input_delay", &[], &[("tau", 0.05)]).band_hz, [corner / half, corner * half]);
        near(ask("unmodeled_resonance", &[], &[("f0", 40.0)]).band_hz, [40.0 / half, 50.0]);
        assert_eq!(ask("actuator_lag", &[], &[("ta", 1e-5)]).band_hz, None, "above what the samples show");
        near(ask("actuator_lag", &[], &[]).band_hz, [0.5, 3.0]);
    }

    #[test]
    fn amplitudes_follow_the_present_ones_and_the_thresholds() {
        near(ask("cubic_stiffness", &[], &[]).amplitude, [2.0, 3.0]);
        near(ask("constant_offset", &[], &[]).amplitude, [0.0, 0.0]);
        near(ask("parameter_drift", &[], &[]).amplitude, [2.0, 2.0]);
        near(ask("input_dead_zone", &[], &[("udz", 0.3)]).amplitude, [0.0, 0.6]);
        near(ask("input_saturation", &[], &[("usat", 1.5)]).amplitude, [1.5, 3.0]);
        near(ask("belt_friction", &[], &[]).amplitude, [1.0, 2.0]);
    }

    #[test]
    fn no_experiment_asks_for_more_than_the_recordings_reach() {
        let all = [
            "coulomb_friction",
            "gravity",
            "quadratic_drag",
            "actuator_lag",
            "constant_offset",
            "parameter_drift",
            "input_dead_zone",
            "input_saturation",
            "my_own",
        ];
        let values = [("ta", 0.1), ("udz", 7.0), ("usat", 9.0)];
        for reached in [[-2.0, 2.0], [0.0, 2.0], [0.5, 2.0], [-2.0, -0.5], [-2.0, 0.0], [0.0, 0.0]] {
            for kind in all {
                let (amplitude, text) = ask_within(reached, None, kind, &values);
                let [low, high] = amplitude.unwrap();
                assert!(reached[0] <= low && low <= high && high <= reached[1], "{kind} {reached:?}: {text}");
            }
        }
        let reported = |kind| ask_within([0.0, 2.0], None, kind, &values).1;
        assert_eq!(
            reported("gravity"),
            "drive v slowly, up to 2 V, the most that these recordings reach, through |θ| < 1: look"
        );
        let loud = reported("quadratic_drag");
        assert!(
            loud.starts_with("drive v at up to 1 V and at up to 2 V, the most that these recordings reach"),
            "{loud}"
        );
        assert_eq!(
            reported("input_dead_zone"),
            "ramp v slowly between 0 V and 2 V, the most that these recordings reach: look"
        );
        assert_eq!(
            reported("input_saturation"),
            "step v from 1 V up to 2 V, the most that these recordings reach: look"
        );
        let negative = |kind| ask_within([-2.0, -0.5], None, kind, &values).1;
        assert_eq!(negative("constant_offset"), "record with v held at −0.5 V: look");
        assert_eq!(negative("parameter_drift"), "record the same again, v up to −2 V, through |θ| < 1: look");
        let uneven = ask_within([-1.0, 2.0], None, "input_dead_zone", &[("udz", 0.8)]).1;
        assert_eq!(uneven, "ramp v slowly between −1 V and 1.6 V: look");
    }

    #[test]
    fn what_the_model_states_of_the_actuator_is_allowed() {
        let reported =
            |stated, kind, values: &[(&str, f64)]| ask_within([-2.0, 2.0], Some(stated), kind, values);
        assert_eq!(reported([-10.0, 10.0], "gravity", &[]).0, Some([2.0, 3.0]));
        let (amplitude, text) = reported([-2.5, 2.5], "quadratic_drag", &[]);
        assert_eq!(amplitude, Some([2.0, 2.5]));
        assert!(text.starts_with("drive v as now, 2 V, and at up to 2.5 V"), "{text}");
        let (amplitude, text) = reported([-2.0, 2.0], "gravity", &[]);
        assert_eq!(amplitude, Some([0.0, 2.0]));
        assert!(
            text.starts_with("drive v slowly, up to 2 V, the most that the model states for it, through"),
            "{text}"
        );
        // Even below what the recordings reached.
        assert_eq!(reported([-1.0, 1.0], "coulomb_friction", &[]).0, Some([0.0, 1.0]));
        assert_eq!(reported([-10.0, 10.0], "input_dead_zone", &[("udz", 3.0)]).0, Some([0.0, 6.0]));
    }

    #[test]
    fn the_alternative_says_what_to_do() {
        let (location, b) = (Location::default(), reach());
        let subject = |kind, alternative| {
            let (own, alternative) = (drive(kind, &[]), drive(alternative, &[]));
            experiment(&Subject { own, alternative, input: None, location: &location, separate: "" }, &b)
        };
        assert_eq!(subject("step_disturbance", "periodic_disturbance").text, "record with v at zero");
        assert_eq!(subject("step_disturbance", "my_own").text, "record the same again, v up to 2 V");
    }

    #[test]
    fn a_remainder_asks_for_its_variable_or_for_time() {
        let reported = |shape| for_remainder(&Location::default(), Some("v"), &reach(), shape).text;
        assert_eq!(
            reported("a term that depends on h"),
            "drive v as now, 2 V, and at up to 3 V: the residual looks like a term that depends on h: slow sweeps \
             over the whole range of that variable, at two amplitudes"
        );
        assert_eq!(
            reported("a term that changes slowly with time"),
            "record the same again, v up to 2 V: the residual looks like a term that changes slowly with time: the \
             same short experiment at the beginning and at the end of a long run"
        );
    }

    #[test]
    fn without_an_input_the_words_remain() {
        let location = Location::default();
        let subject = Subject {
            own: Some(Excitation::Wide),
            alternative: None,
            input: None,
            location: &location,
            separate: "turn it.",
        };
        let mut two = reach();
        two.inputs.push(InputRange { name: "w".into(), ..two.inputs[0].clone() });
        for reach in [Reach::default(), two] {
            let e = experiment(&subject, &reach);
            assert_eq!((e.text.as_str(), e.input, e.amplitude), ("turn it", None, None));
        }
    }
}
