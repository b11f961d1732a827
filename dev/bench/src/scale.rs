//! Cost against length: `greybox identify --block` on recordings of the oscillator, from 10⁴ samples on.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use greybox_simulate::rigs::{Duffing, Sampling};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use serde_json::Value;

use greybox_dev::figure::{Axis, Plot, Series, Style};
use greybox_dev::process;

/// Sample time of the recordings, s.
const DT: f64 = 0.01;
/// Standard deviation of the noise of the displacement, m.
const NOISE: f64 = 0.01;
/// Rows of a block.
const BLOCK: usize = 20_000;
/// Rows simulated at a time.
const CHUNK: usize = 100_000;
/// Memory allowed, bytes.
const MEMORY: f64 = 500e6;

/// What was measured at one length.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Length {
    /// Rows of the recording.
    pub(crate) samples: usize,
    /// Size of the file, bytes.
    pub(crate) file: u64,
    /// CPU time of all threads, s.
    pub(crate) seconds: f64,
    /// Largest memory, bytes.
    pub(crate) memory: Option<u64>,
    /// Passes over the file.
    pub(crate) passes: Option<u64>,
    /// Largest error of a coefficient, relative to its value.
    pub(crate) error: f64,
}

/// Force of the recordings, N: thesis equation 2.19 and a third sine, so that the motion never repeats.
fn force(t: f64) -> f64 {
    Duffing::thesis_force(t) + 15.0 * (2.39 * t).sin()
}

/// The force as recordings hold it: a straight line between two samples.
fn held(t: f64) -> f64 {
    let k = (t / DT + 1e-6).floor();
    let (now, next) = (force(k * DT), force((k + 1.0) * DT));
    now + (t / DT - k) * (next - now)
}

/// Writes a recording of the oscillator of thesis equation 2.18, chunk by chunk.
fn record(path: &Path, samples: usize) -> Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, File::create(path)?);
    writeln!(out, "t,f [N],x [m]")?;
    let mut random = Pcg64Mcg::seed_from_u64(1);
    let noise = Normal::new(0.0, NOISE)?;
    let mut start = [0.0; 2];
    for from in (0..samples).step_by(CHUNK) {
        let rows = CHUNK.min(samples - from);
        let clock = |k: usize| (from + k) as f64 * DT;
        let sampling = Sampling { dt: DT, substeps: 2 };
        let states = Duffing::THESIS.run(sampling, start, rows + 1, |t| held(clock(0) + t))?;
        for (k, [x, _]) in states[..rows].iter().enumerate() {
            let measured = x + noise.sample(&mut random);
            writeln!(out, "{:.2},{:.6},{measured:.6}", clock(k), force(clock(k)))?;
        }
        start = states[rows];
    }
    Ok(out.flush()?)
}

/// Measures lengths 10⁴, 10⁵ … up to `most`.
pub(crate) fn measure(root: &Path, target: &Path, most: usize) -> Result<Vec<Length>> {
    let binary = process::build(root)?;
    let folder = target.join("bench").join("scale");
    std::fs::create_dir_all(&folder)?;
    let decades = (4..).map(|d| 10_usize.pow(d)).take_while(|n| *n <= most);
    let mut out = Vec::new();
    for samples in decades {
        let length = one(&binary, &folder, samples).with_context(|| format!("{samples} samples"))?;
        println!("{}", row(&length));
        out.push(length);
    }
    Ok(out)
}

fn one(binary: &Path, folder: &Path, samples: usize) -> Result<Length> {
    let file = folder.join("recording.csv");
    record(&file, samples)?;
    let out: PathBuf = folder.join("found");
    let mut command = Command::new(binary);
    command.arg("identify").arg(&file).args(["--states", "x", "--inputs", "f", "--order", "3"]);
    command.args(["--library", "tensor", "--block", &BLOCK.to_string(), "--json", "--out"]).arg(&out);
    let run = process::run(&mut command, folder, Duration::from_secs(4 * 3600))?;
    if !run.status.is_some_and(|s| s.success()) {
        bail!("greybox identify failed: {}", std::fs::read_to_string(folder.join("stderr.txt"))?.trim());
    }
    let report: Value = serde_json::from_str(&std::fs::read_to_string(out.join("report.json"))?)?;
    let length = Length {
        samples,
        file: std::fs::metadata(&file)?.len(),
        seconds: run.cpu.unwrap_or(run.seconds),
        memory: run.peak_bytes,
        passes: report["blocks"]["passes"].as_u64(),
        error: worst(&report)?,
    };
    std::fs::remove_file(&file)?;
    Ok(length)
}

/// Largest relative error of the coefficients; an error where the terms are not those of the oscillator.
fn worst(report: &Value) -> Result<f64> {
    let Duffing { m, k1, k3, c1, c2, c3 } = Duffing::THESIS;
    let truth = [("x''", m), ("x", k1), ("x^3", k3), ("x'", c1), ("x^2*x'", c2), ("x'^3", c3)];
    let terms = report["equations"]["x"]["terms"].as_array().context("no terms in the report")?;
    let found: Vec<&str> = terms.iter().filter_map(|t| t["expression"].as_str()).collect();
    ensure!(found.len() == truth.len(), "the terms found are {}", found.join(", "));
    truth.iter().try_fold(0.0_f64, |worst, (name, wanted)| {
        let at = found.iter().position(|f| f == name).with_context(|| format!("{name} is not found"))?;
        let value = terms[at]["value"].as_f64().context("a term without value")?;
        Ok(worst.max((value / wanted - 1.0).abs()))
    })
}

fn row(l: &Length) -> String {
    let memory = l.memory.map_or_else(|| "?".to_owned(), |m| format!("{:.0} MB", 1e-6 * m as f64));
    let passes = l.passes.map_or_else(|| "whole".to_owned(), |p| p.to_string());
    let each = 1e6 * l.seconds / l.samples as f64;
    format!(
        "| 10^{:.0} | {:.1} MB | {:.1} s | {each:.1} µs | {memory} | {passes} | {:.1e} |",
        (l.samples as f64).log10(),
        1e-6 * l.file as f64,
        l.seconds,
        l.error
    )
}

/// Whether memory stayed within what is allowed.
pub(crate) fn is_met(lengths: &[Length]) -> bool {
    lengths.iter().all(|l| l.memory.is_none_or(|m| m as f64 <= MEMORY))
}

/// The table of the book's page.
pub(crate) fn table(lengths: &[Length]) -> String {
    let mut text = String::from(
        "| samples | file | CPU time | per sample | memory | passes | largest error |\n|---|---|---|---|---|---|---|\n",
    );
    for l in lengths {
        let _ = writeln!(text, "{}", row(l));
    }
    text + "\n![Time against length](speed-scale.svg)\n"
}

/// Time against length on logarithmic axes, with a line of slope one.
pub(crate) fn plot(lengths: &[Length]) -> Result<String> {
    let points: Vec<[f64; 2]> = lengths.iter().map(|l| [l.samples as f64, l.seconds]).collect();
    let last = points.last().context("nothing was measured")?;
    let line = points.iter().map(|p| [p[0], p[0] / last[0] * last[1]]).collect();
    let plot = Plot {
        alt: "Time of an identification against the length of its recording".into(),
        x: Axis::log("samples"),
        y: Axis::log("CPU time in s"),
        series: vec![
            Series::new("proportional", Style::Dashed, line),
            Series::new("measured", Style::Points, points),
        ],
    };
    plot.to_svg().context("nothing to draw")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_goes_on_from_chunk_to_chunk() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.csv");
        record(&path, 1000).unwrap();
        let recording = greybox_recording::read_csv(&path).unwrap();
        assert_eq!(recording.time.len(), 1000);
        let states = Duffing::THESIS.run(Sampling { dt: DT, substeps: 2 }, [0.0; 2], 1000, force).unwrap();
        let x = &recording.channel("x").unwrap().values;
        let left = x.iter().zip(&states).map(|(x, s)| (x - s[0]).powi(2)).sum::<f64>() / 1000.0;
        assert!((left.sqrt() / NOISE - 1.0).abs() < 0.1, "{left}");
    }

    #[test]
    fn only_the_oscillator_counts_as_found() {
        let report = |terms: Value| serde_json::json!({"equations": {"x": {"terms": terms}}});
        let term =
            |expression: &str, value: f64| serde_json::json!({"expression": expression, "value": value});
        let all = [("x''", 2.0), ("x", 6.0), ("x^3", 0.1), ("x'", 1.0), ("x^2*x'", 0.21), ("x'^3", 1.0)];
        let all: Vec<Value> = all.iter().map(|(e, v)| term(e, *v)).collect();
        assert!((worst(&report(all.clone().into())).unwrap() - 0.05).abs() < 1e-9);
        assert!(worst(&report(all[..5].to_vec().into())).is_err());
    }
}
