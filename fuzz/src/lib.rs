//! What must hold of any bytes, one function per fuzz target: each panics where something does not.

#[path = "../../crates/recording/tests/sound.rs"]
mod sound;

use std::sync::{Arc, Mutex, PoisonError};

use greybox_diagnose::{Options, ProgressListener, diagnose as run};
use greybox_model::{Expr, Model, System, Unit, WriteOptions, parse, parse_equation};
use greybox_recording::{Channel, Recording, RecordingError};
use greybox_report::contract::Report;
use greybox_report::convert::{self, Sources};

/// A target's name and its function.
pub type Target = (&'static str, fn(&[u8]));

/// All targets.
pub const TARGETS: [Target; 8] = [
    ("expression", expression),
    ("model", model),
    ("csv", csv),
    ("mat", mat),
    ("npz", npz),
    ("hdf5", hdf5),
    ("mcap", mcap),
    ("diagnose", diagnose),
];

/// Text as an expression, an equation and a unit: what is read is printed and read again as the same, derivatives have a
/// size of their own kind, and errors point into the text.
pub fn expression(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    match parse(text) {
        Ok(parsed) => {
            same_again(&parsed.expr);
            let simple = parsed.expr.simplify();
            // Nothing that was read, so that it may be nested deeper.
            if parse(&simple.to_string()).is_ok_and(|again| again.expr != simple) {
                panic!("`{simple}` is read as something else");
            }
            assert_eq!(simple.simplify(), simple, "simplifying `{text}` again changes it");
            if let Some((name, primes, _)) = parsed.names.first() {
                let slope = parsed.expr.derivative(name, *primes).simplify();
                assert!(
                    size(&slope) <= 40 * size(&parsed.expr).pow(2) + 40,
                    "the derivative of `{text}` is huge"
                );
                let _ = parsed.expr.affine_in(&[(name, *primes)]);
            }
        }
        Err(error) => assert!(text.get(error.span.clone()).is_some(), "{error}: {:?} is outside", error.span),
    }
    match parse_equation(text) {
        Ok(equation) => {
            same_again(&equation.lhs.expr);
            same_again(&equation.rhs.expr);
        }
        Err(error) => assert!(text.get(error.span.clone()).is_some(), "{error}: {:?} is outside", error.span),
    }
    match Unit::parse(text) {
        Ok(unit) => {
            let again = Unit::parse(&unit.text).unwrap_or_else(|e| panic!("`{unit}`: {e}"));
            assert_eq!(again, unit);
            let si = Unit::si(unit.dimension);
            let again = Unit::parse(&si.text).unwrap_or_else(|e| panic!("`{si}` of `{text}`: {e}"));
            assert!(again.dimension.same(&unit.dimension), "`{text}` is `{si}`, which is read as {again:?}");
            assert_eq!(again.factor, 1.0);
        }
        Err(error) => assert!(text.get(error.span.clone()).is_some(), "{error}: {:?} is outside", error.span),
    }
}

fn same_again(expr: &Expr) {
    let text = expr.to_string();
    match parse(&text) {
        Ok(again) => assert_eq!(again.expr, *expr, "`{text}`"),
        Err(error) => panic!("`{text}`: {error}"),
    }
}

fn size(expr: &Expr) -> usize {
    let mut nodes = 0;
    expr.walk(&mut |_| nodes += 1);
    nodes
}

/// Text as a model file: a model that loads is written, loads again and is the same; it compiles or says why not.
pub fn model(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let model = match Model::from_toml(text, "fuzz.toml") {
        Ok(model) => model,
        Err(error) => {
            assert!(error.span().is_none_or(|span| text.get(span).is_some()), "{error}: outside of the text");
            assert!(!error.to_string().is_empty());
            return;
        }
    };
    let options = WriteOptions { original: Some(text), ..WriteOptions::default() };
    // Where a text mixes both ends of lines, all become the same.
    let lines = |text: &str| text.replace("\r\n", "\n");
    assert_eq!(lines(&model.to_toml(&options)), lines(text), "an unchanged model is written anew");
    let written = model.to_toml(&WriteOptions::default());
    let again = Model::from_toml(&written, "fuzz.toml")
        .unwrap_or_else(|e| panic!("{e} in what was written:\n{written}"));
    assert_eq!(again.equations, model.equations, "{written}");
    assert_eq!(again.measurements, model.measurements, "{written}");
    let names = |m: &Model| -> Vec<String> {
        let states = m.states.iter().map(|s| format!("{} {:?} {}", s.name, s.channel, s.order));
        let inputs = m.inputs.iter().map(|i| format!("{} {:?} {:?}", i.name, i.channel, i.hold));
        let parameters = m.parameters.iter().map(|p| format!("{} {:?}", p.name, p.fixed));
        states.chain(inputs).chain(parameters).collect()
    };
    assert_eq!(names(&again), names(&model), "{written}");
    assert_eq!(again.to_toml(&WriteOptions::default()), written);
    let finite = |p: &greybox_model::Parameter| p.value.is_finite() && p.std.is_none_or(f64::is_finite);
    assert!(model.parameters.iter().all(finite), "a parameter is not finite");
    let _ = System::compile(&model);
}

/// Bytes as a CSV file: a recording is sound, is written and is read again as the same.
pub fn csv(bytes: &[u8]) {
    let recording = match greybox_recording::parse_csv(bytes, "fuzz.csv") {
        Ok(recording) => recording,
        Err(error) => {
            assert!(error.to_string().starts_with("fuzz.csv"), "the file is not named: {error}");
            return;
        }
    };
    sound::sound(&recording, Some(bytes.len()));
    let headers: Vec<String> = recording.channels.iter().map(header).collect();
    let columns: Vec<(&str, &[f64])> =
        headers.iter().zip(&recording.channels).map(|(h, c)| (h.as_str(), c.values.as_slice())).collect();
    let mut written = Vec::new();
    greybox_recording::write_csv(&mut written, &recording.time, &columns).expect("what was read is written");
    match greybox_recording::parse_csv(&written[..], "fuzz.csv") {
        Ok(again) => {
            let bits = |values: &[f64]| -> Vec<u64> { values.iter().map(|v| v.to_bits()).collect() };
            assert_eq!(bits(&again.time), bits(&recording.time));
            for (a, b) in again.channels.iter().zip(&recording.channels) {
                assert_eq!((&a.name, &a.unit, bits(&a.values)), (&b.name, &b.unit, bits(&b.values)));
            }
            assert_eq!(again.channels.len(), recording.channels.len());
        }
        // Digits are printed as needed: without those of the file the clock may look coarser than it was.
        Err(RecordingError::NoUsablePiece { .. }) => {}
        Err(error) => panic!("{error} in what was written:\n{}", String::from_utf8_lossy(&written)),
    }
}

fn header(channel: &Channel) -> String {
    match &channel.unit {
        Some(unit) => format!("{} [{unit}]", channel.name),
        None => channel.name.clone(),
    }
}

/// Bytes as a MAT-file: a recording is sound.
pub fn mat(bytes: &[u8]) {
    // What is compressed may be a thousand times as long.
    let _ = sound::read("fuzz.mat", bytes, Some(1100 * bytes.len()));
}

/// Bytes as an archive of NumPy arrays, or as one array: a recording is sound.
pub fn npz(bytes: &[u8]) {
    let _ = sound::read("fuzz.npz", bytes, Some(1100 * bytes.len()));
}

/// Bytes as HDF5: a recording is sound. What is not stored is filled, so that the file's length says nothing of the rows.
pub fn hdf5(bytes: &[u8]) {
    let _ = sound::read("fuzz.h5", bytes, None);
}

/// Bytes as a log: a recording is sound.
pub fn mcap(bytes: &[u8]) {
    let _ = sound::read("fuzz.mcap", bytes, None);
}

/// Work after which the search of [`diagnose`] looks for nothing more, and the most that a whole diagnosis may take: a
/// round that has begun is ended, and the verdict's simulations come on top.
const WORK: u64 = 3_000_000;
const MOST_WORK: u64 = 400 * WORK;

/// Bytes as choices of a model and of a short recording, diagnosed within little work: an answer, whose JSON and page
/// are written, whose JSON is read again as the same and whose model loads, or an error that can be told.
pub fn diagnose(bytes: &[u8]) {
    let mut choices = Choices(bytes);
    let text = choices.model();
    let Ok(model) = Model::from_toml(&text, "fuzz.toml") else {
        panic!("the template does not load:\n{text}")
    };
    let Some(train) = choices.recording("train.csv") else { return };
    let holdout: Vec<Recording> = choices.recording("held.csv").into_iter().collect();
    let options = Options { work: WORK, ..Options::default() };
    let meter = Meter::default();
    let train = [train];
    let diagnosis = match run(&model, &train, &holdout, &options, &meter) {
        Ok(diagnosis) => diagnosis,
        Err(error) => {
            assert!(!error.to_string().is_empty());
            return;
        }
    };
    let work = meter.done();
    assert!(work <= MOST_WORK, "the work is {work}");
    let sources = Sources { model_file: "fuzz.toml", model_text: &text, train: &train, holdout: &holdout };
    let report = convert::report(&diagnosis, &sources);
    let json = report.to_json().expect("a report is written");
    let again = Report::from_json(&json).unwrap_or_else(|e| panic!("{e} in\n{json}"));
    assert_eq!(again.to_json().expect("as before"), json);
    convert::page(&diagnosis, report, &sources).to_html().expect("a page is written");
    let improved = convert::improved_toml(&diagnosis, &text);
    Model::from_toml(&improved, "improved.toml").unwrap_or_else(|e| panic!("{e} in\n{improved}"));
}

/// Keeps the meter of a diagnosis.
#[derive(Default)]
struct Meter(Mutex<Option<Arc<greybox_calibrate::Work>>>);

impl Meter {
    fn done(&self) -> u64 {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).as_ref().map_or(0, |work| work.done())
    }
}

impl ProgressListener for Meter {
    fn begins(&self, work: &Arc<greybox_calibrate::Work>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(work.clone());
    }
}

/// Bytes taken from the front; zeros where there are no more.
struct Choices<'a>(&'a [u8]);

/// Equations of one state `x` and one input `u`.
const EQUATIONS: [&str; 6] = [
    "m*x'' + c*x' + k*x = u",
    "m*x'' + c*sign(x') + k*x = u",
    "m*x'' + c*x' + k*sin(x) = delay(u, tau)",
    "m*x' + c*x + k*x^3 = saturate(u, 0.5)",
    "m*x'' + c*abs(x')*x' + k*deadzone(x, 0.1) = u",
    "m*x'' + c*x' + k*sqrt(x) = u",
];

/// Values of parameters and samples, from the plain to the extreme.
const VALUES: [f64; 16] =
    [1.0, 0.0, -1.0, 0.5, 2.0, 10.0, 100.0, -0.1, 1e-3, 1e-9, 1e9, -1e6, 1e30, 1e-300, 1e300, -1e300];

impl Choices<'_> {
    fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    fn value(&mut self) -> f64 {
        VALUES[usize::from(self.byte()) % VALUES.len()]
    }

    fn model(&mut self) -> String {
        let equation = EQUATIONS[usize::from(self.byte()) % EQUATIONS.len()];
        let hold = ["linear", "zero", "band_limited"][usize::from(self.byte()) % 3];
        let free = self.byte();
        let mut parameters = String::new();
        for (k, name) in ["m", "c", "k"].into_iter().enumerate() {
            let value = self.value();
            let fixed = if free >> k & 1 == 1 { ", fixed = true" } else { "" };
            parameters += &format!("{name} = {{ value = {value:?}{fixed} }}\n");
        }
        if equation.contains("tau") {
            parameters += "tau = { value = 0.03, unit = \"s\", fixed = true }\n";
        }
        format!(
            "[inputs]\nu = {{ hold = \"{hold}\" }}\n[states]\nx = {{}}\n[parameters]\n{parameters}[equations]\n\
             e = \"{equation}\"\n"
        )
    }

    /// A recording of 24 to 87 rows; `None` where the first byte says so. A sample is a byte: missing, one of
    /// [`VALUES`], or a small number.
    fn recording(&mut self, name: &str) -> Option<Recording> {
        let rows = self.byte();
        if rows >= 64 && name == "held.csv" {
            return None;
        }
        let rows = 24 + usize::from(rows % 64);
        let dt = [0.01, 0.1, 1.0, 1e-6, 1e6][usize::from(self.byte()) % 5];
        let gap = usize::from(self.byte());
        let time = (0..rows).map(|k| dt * (k + if k >= gap { 7 } else { 0 }) as f64).collect();
        let mut channels = Vec::new();
        for name in ["u", "x"] {
            let pattern = self.byte();
            let values = (0..rows).map(|k| self.sample(pattern, k)).collect();
            channels.push(Channel { name: name.to_owned(), unit: None, values });
        }
        Recording::from_columns(name, time, channels).ok()
    }

    fn sample(&mut self, pattern: u8, k: usize) -> f64 {
        let wave = (k as f64 * f64::from(1 + pattern / 16) * 0.1).sin();
        match pattern % 4 {
            0 => wave,
            1 => wave + f64::from(self.byte().cast_signed()) * 1e-3,
            2 => f64::from(self.byte().cast_signed()) / 64.0,
            _ => match self.byte() {
                0 => f64::NAN,
                b @ 1..=16 => VALUES[usize::from(b) - 1],
                b => f64::from(b.cast_signed()),
            },
        }
    }
}
