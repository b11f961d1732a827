//! Cost against length of a whole diagnosis: `greybox diagnose` on recordings of a throttle whose model lacks its Coulomb friction.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use greybox_dev::process;
use greybox_simulate::rigs::Throttle;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use serde_json::Value;

/// Sample time of the recordings, s.
const DT: f64 = 0.01;
/// Standard deviation of the noise of the angle, rad.
const NOISE: f64 = 0.002;
/// Samples for which a torque is held.
const HELD: usize = 30;
/// Memory allowed for each sample beside what a short recording takes, bytes (measured: 6000 at 10⁴ samples, of which half are looked
/// at by the search, 2400 from 10⁵ on).
const MEMORY: f64 = 8000.0;

/// The throttle without its friction, its spring and its damping not quite known.
const MODEL: &str = r#"
name = "throttle"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.03, unit = "N*m*s/rad" }
k = { value = 0.7, unit = "N*m/rad" }
[states]
angle = { unit = "rad" }
[equations]
plate = "J*angle'' + b*angle' + k*angle = torque"
"#;

/// What was measured at one length.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Length {
    /// Rows of the recording.
    pub(crate) samples: usize,
    /// CPU time of all threads, s.
    pub(crate) seconds: f64,
    /// Largest memory, bytes.
    pub(crate) memory: Option<u64>,
    /// Mechanisms that were found.
    pub(crate) found: Vec<String>,
    /// Error of the friction, relative to its value, where that is what was found.
    pub(crate) error: Option<f64>,
}

/// Writes a recording.
fn record(path: &Path, samples: usize) -> Result<()> {
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    let mut random = Pcg64Mcg::seed_from_u64(1);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let (mut state, mut torque) = ([0.0; 2], 0.0);
    writeln!(out, "t,torque [N*m],angle [rad]")?;
    for k in 0..samples {
        if k % HELD == 0 {
            torque = 0.5 * normal();
        }
        writeln!(out, "{:.2},{torque:.9},{:.9}", k as f64 * DT, state[0] + NOISE * normal())?;
        state = Throttle::NEW.step(state, torque, DT, 20);
    }
    Ok(out.flush()?)
}

/// Measures lengths 10³, 10⁴ … up to `most`.
pub(crate) fn measure(root: &Path, target: &Path, most: usize) -> Result<Vec<Length>> {
    let binary = process::build(root)?;
    let folder = target.join("bench").join("long");
    std::fs::create_dir_all(&folder)?;
    let model = folder.join("throttle.toml");
    std::fs::write(&model, MODEL)?;
    let mut out = Vec::new();
    for samples in (3..).map(|d| 10_usize.pow(d)).take_while(|n| *n <= most) {
        let length = one(&binary, &folder, &model, samples).with_context(|| format!("{samples} samples"))?;
        println!("{}", row(&length));
        out.push(length);
    }
    Ok(out)
}

fn one(binary: &Path, folder: &Path, model: &Path, samples: usize) -> Result<Length> {
    let file = folder.join("recording.csv");
    record(&file, samples)?;
    let out = folder.join("found");
    let mut command = Command::new(binary);
    command.arg("diagnose").arg(model).arg(&file).arg("--out").arg(&out);
    let run = process::run(&mut command, folder, Duration::from_secs(4 * 3600))?;
    if !run.status.is_some_and(|s| s.success()) {
        bail!("greybox diagnose failed: {}", std::fs::read_to_string(folder.join("stderr.txt"))?.trim());
    }
    let report: Value = serde_json::from_str(&std::fs::read_to_string(out.join("report.json"))?)?;
    std::fs::remove_file(&file)?;
    let (found, error) = found(&report);
    let seconds = run.cpu.unwrap_or(run.seconds);
    Ok(Length { samples, seconds, memory: run.peak_bytes, found, error })
}

/// What a report names, and by how much the friction is off where it is named.
fn found(report: &Value) -> (Vec<String>, Option<f64>) {
    let mechanisms = report["mechanisms"].as_array().map_or(&[][..], Vec::as_slice);
    let kind = |m: &Value| m["kind"].as_str().unwrap_or("?").replace('_', " ");
    let friction = mechanisms.iter().find(|m| m["kind"] == "coulomb_friction");
    let value = friction.and_then(|m| m["parameters"]["fc"]["value"].as_f64());
    (mechanisms.iter().map(kind).collect(), value.map(|v| (v / Throttle::NEW.coulomb - 1.0).abs()))
}

fn row(l: &Length) -> String {
    let memory = l.memory.map_or_else(|| "?".to_owned(), |m| format!("{:.0} MB", 1e-6 * m as f64));
    let error = l.error.map_or_else(String::new, |e| format!("{:.2} %", 100.0 * e));
    format!(
        "| 10^{:.0} | {:.1} s | {:.2} ms | {memory} | {} | {error} |",
        (l.samples as f64).log10(),
        l.seconds,
        1e3 * l.seconds / l.samples as f64,
        l.found.join(", ")
    )
}

/// Whether memory grew no faster than is allowed.
pub(crate) fn is_met(lengths: &[Length]) -> bool {
    let Some((first, rest)) = lengths.split_first() else { return false };
    let allowed = |l: &Length| Some(first.memory? as f64 + MEMORY * (l.samples - first.samples) as f64);
    rest.iter().all(|l| l.memory.is_none_or(|m| allowed(l).is_none_or(|most| m as f64 <= most)))
}

/// The table of the book's page.
pub(crate) fn table(lengths: &[Length]) -> String {
    let mut text = String::from(
        "| samples | CPU time | per sample | memory | found | error of the friction |\n|---|---|---|---|---|---|\n",
    );
    for l in lengths {
        let _ = writeln!(text, "{}", row(l));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_is_that_of_the_throttle() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.csv");
        record(&path, 900).unwrap();
        let recording = greybox_recording::read_csv(&path).unwrap();
        let torque = &recording.channel("torque").unwrap().values;
        let angle = &recording.channel("angle").unwrap().values;
        let (mut state, mut squares) = ([0.0; 2], 0.0);
        for k in 0..900 {
            squares += (angle[k] - state[0]).powi(2);
            state = Throttle::NEW.step(state, torque[k], DT, 20);
        }
        assert!(((squares / 900.0).sqrt() / NOISE - 1.0).abs() < 0.1, "{squares}");
    }

    #[test]
    fn a_row_says_what_was_found() {
        let report = serde_json::json!({"mechanisms": [
            {"kind": "coulomb_friction", "parameters": {"fc": {"value": 0.101}}},
            {"kind": "feedback_delay", "parameters": {}},
        ]});
        let (names, error) = found(&report);
        assert_eq!(names, ["coulomb friction", "feedback delay"]);
        assert!((error.unwrap() - 0.01).abs() < 1e-9);
        let length = |samples, memory| Length {
            samples,
            seconds: 2.0,
            memory: Some(memory),
            found: names.clone(),
            error,
        };
        assert_eq!(
            row(&length(1000, 25_000_000)),
            "| 10^3 | 2.0 s | 2.00 ms | 25 MB | coulomb friction, feedback delay | 1.00 % |"
        );
        assert!(is_met(&[length(1000, 25_000_000), length(100_000, 800_000_000)]));
        assert!(!is_met(&[length(1000, 25_000_000), length(100_000, 900_000_000)]));
        assert!(found(&Value::Null).0.is_empty());
    }
}
