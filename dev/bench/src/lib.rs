//! `cargo xtask bench`: the CPU time of every hot path, beside the tools that people use today.
//!
//! A row is one hot path through the public interface of the crates. With `--peers` a Python process per tool works on
//! the same data, in turns with ours (A B A B …); both answers are compared first, and a row whose answers disagree is
//! an error, not a speed-up. One core on both sides; medians of CPU time, because machines are shared.

// A command that measures: its answers go to standard output, its complaints to standard error.
#![allow(clippy::disallowed_methods, clippy::print_stdout, clippy::print_stderr)]

mod case;
mod control;
mod instructions;
mod long;
pub(crate) mod page;
mod peak;
mod peer;
mod scale;
mod simulation;
mod sparse;
mod watching;
mod whole;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use cpu_time::ProcessTime;
use serde::Serialize;

use self::case::{Against, Answer, Case, Row};
use greybox_dev::median;
use greybox_dev::{Ending, process};

/// What `bench` takes.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Run the peers too, in a Python environment made from dev/bench/requirements.txt
    #[arg(long)]
    peers: bool,
    /// Only this row (may be given more than once); `list` names them
    #[arg(long, value_name = "NAME")]
    only: Vec<String>,
    /// Rounds of each side
    #[arg(long, value_name = "N", default_value_t = 7, value_parser = clap::value_parser!(u32).range(5..=1000))]
    rounds: u32,
    /// Least CPU time of a round, s
    #[arg(long, value_name = "SECONDS", default_value_t = 0.3)]
    seconds: f64,
    /// Write the measurements as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Instead, identify recordings of 10⁴, 10⁵ … up to so many samples, in blocks
    #[arg(long, value_name = "SAMPLES", conflicts_with_all = ["peers", "only"])]
    scale: Option<usize>,
    /// Instead, diagnose recordings of 10³, 10⁴ … up to so many samples
    #[arg(long, value_name = "SAMPLES", conflicts_with_all = ["peers", "only", "scale"])]
    long: Option<usize>,
    /// Instead, count the instructions of every row with valgrind and hold them against dev/bench/instructions.json
    #[arg(long, conflicts_with_all = ["peers", "scale", "long"])]
    instructions: bool,
    /// With --instructions: accept the counts
    #[arg(long, requires = "instructions", conflicts_with = "only")]
    write: bool,
    /// One row in this process, for --instructions
    #[arg(long, value_name = "NAME", hide = true)]
    count_one: Option<String>,
    /// Write the table of docs/src/speed.md that --peers, --scale or --long makes
    #[arg(long, conflicts_with = "only")]
    write_docs: bool,
}

/// What takes longer than this, s, is not asked again: a peer of which nothing is compiled, whose time is far from any goal, and
/// a whole diagnosis, whose noise is averaged within it.
const SLOW: f64 = 10.0;

/// All rows, in the order of the table.
fn rows() -> Vec<Row> {
    [sparse::rows(), simulation::rows(), control::rows(), watching::rows(), whole::rows()]
        .into_iter()
        .flatten()
        .collect()
}

/// What a run measured.
#[derive(Debug, Serialize)]
struct Report {
    machine: Machine,
    /// Floating-point peak of one core, operations per second, where a row needed it.
    peak: Option<f64>,
    rows: Vec<Measured>,
}

#[derive(Debug, Serialize)]
struct Machine {
    processor: String,
    cores: usize,
}

/// A measured row.
#[derive(Debug, Serialize)]
struct Measured {
    name: String,
    what: String,
    unit: String,
    /// Median CPU time of a unit, s.
    ours: f64,
    comparisons: Vec<Comparison>,
}

/// Ours beside something else.
#[derive(Debug, Serialize)]
struct Comparison {
    with: String,
    /// Median CPU time of a unit, s (of ours on one core: wall-clock time).
    theirs: Option<f64>,
    /// How many times faster ours is; of the peak: the share reached.
    ratio: f64,
    goal: f64,
    met: bool,
    /// How the answers compare.
    agreement: Option<String>,
}

/// Runs the command.
pub fn run(root: &Path, arguments: &Arguments) -> Result<Ending> {
    let all = rows();
    if let Some(name) = &arguments.count_one {
        let row =
            all.iter().find(|r| r.name == *name).with_context(|| format!("there is no row \"{name}\""))?;
        return instructions::one(row).map(|()| Ending::Done);
    }
    let names: Vec<&str> = all.iter().map(|r| r.name).collect();
    if let Some(unknown) = arguments.only.iter().find(|n| !names.contains(&n.as_str())) {
        if unknown == "list" {
            println!("{}", names.join("\n"));
            return Ok(Ending::Done);
        }
        bail!("there is no row \"{unknown}\"; the rows are {}", names.join(", "));
    }
    if !(arguments.seconds > 0.0 && arguments.seconds <= 60.0) {
        bail!("--seconds {} is not in 0..60", arguments.seconds);
    }
    let target = process::target(root);
    if let Some(most) = arguments.scale {
        return scale(root, &target, most, arguments);
    }
    if let Some(most) = arguments.long {
        return long(root, &target, most, arguments);
    }
    if arguments.instructions {
        let good = instructions::run(root, &target, &all, &arguments.only, arguments.write)?;
        return Ok(if good { Ending::Done } else { Ending::Missed });
    }
    if arguments.write_docs && !arguments.peers {
        bail!("--write-docs needs --peers, --scale or --long");
    }
    let python = if arguments.peers {
        Some(greybox_dev::python::environment(
            &root.join("dev").join("bench").join("requirements.txt"),
            &target.join("bench").join("python"),
            &[],
        )?)
    } else {
        None
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let bench = Bench { root, target: &target, python: python.as_deref(), arguments, one };
    let mut report = Report { machine: Machine::here(), peak: None, rows: Vec::new() };
    let mut failed = false;
    for row in all.iter().filter(|r| arguments.only.is_empty() || arguments.only.iter().any(|n| n == r.name))
    {
        match bench.row(row, &mut report.peak) {
            Ok(measured) => {
                print!("{}", measured.text());
                report.rows.push(measured);
            }
            Err(e) => {
                failed = true;
                println!("{}: FAILED: {e:#}", row.name);
            }
        }
    }
    if let Some(path) = &arguments.json {
        write_json(path, &report)?;
    }
    if failed {
        return Ok(Ending::Missed);
    }
    if arguments.write_docs {
        page::write(root, &report)?;
    }
    let missed = report.rows.iter().flat_map(|r| &r.comparisons).filter(|c| !c.met).count();
    if missed > 0 {
        println!("{missed} goals missed");
    }
    Ok(if missed == 0 { Ending::Done } else { Ending::Missed })
}

/// `--scale`.
fn scale(root: &Path, target: &Path, most: usize, arguments: &Arguments) -> Result<Ending> {
    let lengths = scale::measure(root, target, most)?;
    if let Some(path) = &arguments.json {
        write_json(path, &lengths)?;
    }
    if arguments.write_docs {
        page::write_scale(root, &lengths)?;
    }
    Ok(if scale::is_met(&lengths) { Ending::Done } else { Ending::Missed })
}

/// `--long`.
fn long(root: &Path, target: &Path, most: usize, arguments: &Arguments) -> Result<Ending> {
    let lengths = long::measure(root, target, most)?;
    if let Some(path) = &arguments.json {
        write_json(path, &lengths)?;
    }
    if arguments.write_docs {
        page::write_long(root, &lengths)?;
    }
    Ok(if long::is_met(&lengths) { Ending::Done } else { Ending::Missed })
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value)? + "\n";
    std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))
}

struct Bench<'a> {
    root: &'a Path,
    target: &'a Path,
    python: Option<&'a Path>,
    arguments: &'a Arguments,
    one: rayon::ThreadPool,
}

impl Bench<'_> {
    fn row(&self, row: &Row, peak: &mut Option<f64>) -> Result<Measured> {
        let mut case = (row.make)().context("the row cannot be prepared")?;
        let answer = self.answer(&mut case)?;
        let mut samples = Vec::new();
        let mut comparisons = Vec::new();
        match &row.against {
            Against::Peers(peers) => {
                if let Some(python) = self.python {
                    for peer in *peers {
                        let folder = self.target.join("bench").join("data").join(peer.function);
                        let mut worker =
                            peer::Worker::start(self.root, python, &folder, peer.function, &case)?;
                        let agreement = (case.agree)(peer.name, &answer, &worker.answer)
                            .with_context(|| format!("the answers of greybox and {} disagree", peer.name))?;
                        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
                        let slow = worker.first > SLOW;
                        if slow {
                            theirs.push(worker.first / case.units);
                        }
                        for _ in 0..self.arguments.rounds {
                            ours.push(self.ours(&mut case)?);
                            if !slow {
                                theirs.push(worker.measure(self.arguments.seconds)? / case.units);
                            }
                        }
                        let (mine, theirs) = (median(ours.clone()), median(theirs));
                        samples.extend(ours);
                        let with = peer.name.to_owned();
                        let note = if slow { "; theirs is one call, slow as it is" } else { "" };
                        let agreement = Some(agreement + note);
                        comparisons.push(Comparison::new(
                            with,
                            Some(theirs),
                            theirs / mine,
                            peer.goal,
                            agreement,
                        ));
                    }
                }
                if samples.is_empty() {
                    samples = self.rounds(&mut case)?;
                }
            }
            Against::Peak { operations, goal } => {
                let mut rates = Vec::new();
                for _ in 0..self.arguments.rounds {
                    samples.push(self.ours(&mut case)?);
                    rates.push(self.peak());
                }
                let rate = median(rates);
                *peak = Some(rate);
                let share = operations / median(samples.clone()) / rate;
                comparisons.push(Comparison::new("the core's peak".to_owned(), None, share, *goal, None));
            }
            Against::TwoCores { goal } => {
                samples = self.rounds(&mut case)?;
                let two = rayon::ThreadPoolBuilder::new().num_threads(2).build()?;
                let (mut single, mut double) = (f64::INFINITY, f64::INFINITY);
                // Wall-clock time: the least of many, since others' work only ever adds to it.
                for _ in 0..10 * self.arguments.rounds {
                    single = single.min(wall(&self.one, &mut case)?);
                    double = double.min(wall(&two, &mut case)?);
                }
                let with = "one core (wall-clock time)".to_owned();
                comparisons.push(Comparison::new(with, Some(single), single / double, *goal, None));
            }
        }
        Ok(Measured {
            name: row.name.to_owned(),
            what: row.what.to_owned(),
            unit: row.unit.to_owned(),
            ours: median(samples),
            comparisons,
        })
    }

    /// One call, on one core.
    fn answer(&self, case: &mut Case) -> Result<Answer> {
        on(&self.one, case)
    }

    /// As many rounds as asked for; of what is slow, one.
    fn rounds(&self, case: &mut Case) -> Result<Vec<f64>> {
        let start = ProcessTime::now();
        let first = self.ours(case)?;
        let more =
            if start.elapsed().as_secs_f64() > SLOW { 0 } else { self.arguments.rounds.saturating_sub(1) };
        std::iter::once(Ok(first)).chain((0..more).map(|_| self.ours(case))).collect()
    }

    /// CPU time of a unit, over calls for a round and at least one.
    fn ours(&self, case: &mut Case) -> Result<f64> {
        let wanted = Duration::from_secs_f64(self.arguments.seconds);
        let start = ProcessTime::now();
        let mut calls = 0.0;
        loop {
            std::hint::black_box(self.answer(case)?);
            calls += 1.0;
            let spent = start.elapsed();
            if spent >= wanted {
                return Ok(spent.as_secs_f64() / (calls * case.units));
            }
        }
    }

    /// Operations per second of CPU time.
    fn peak(&self) -> f64 {
        let wanted = Duration::from_secs_f64(self.arguments.seconds);
        let start = ProcessTime::now();
        let mut operations = 0.0;
        loop {
            operations += peak::run();
            let spent = start.elapsed();
            if spent >= wanted {
                return operations / spent.as_secs_f64();
            }
        }
    }
}

/// One call in a pool of threads.
fn on(pool: &rayon::ThreadPool, case: &mut Case) -> Result<Answer> {
    pool.install(&mut case.work)
}

/// Wall-clock time of one call, s.
fn wall(pool: &rayon::ThreadPool, case: &mut Case) -> Result<f64> {
    let start = Instant::now();
    std::hint::black_box(on(pool, case)?);
    Ok(start.elapsed().as_secs_f64())
}

impl Comparison {
    fn new(with: String, theirs: Option<f64>, ratio: f64, goal: f64, agreement: Option<String>) -> Self {
        Self { with, theirs, ratio, goal, met: ratio >= goal, agreement }
    }

    /// "123 ×" or, of the peak, "62 %".
    fn times(&self, value: f64) -> String {
        if self.theirs.is_none() {
            format!("{:.0} %", 100.0 * value)
        } else if value < 10.0 {
            format!("{value:.1} ×")
        } else {
            format!("{value:.0} ×")
        }
    }

    fn verdict(&self) -> &'static str {
        if self.met { "met" } else { "missed" }
    }
}

impl Measured {
    fn text(&self) -> String {
        let mut text = format!("{}: {} per {} ({})\n", self.name, duration(self.ours), self.unit, self.what);
        for c in &self.comparisons {
            let theirs = c.theirs.map_or_else(String::new, |t| format!(" {}", duration(t)));
            let (ratio, goal) = (c.times(c.ratio), c.times(c.goal));
            text += &format!("    {}{theirs}: {ratio}, goal {goal}: {}\n", c.with, c.verdict());
            if let Some(agreement) = &c.agreement {
                text += &format!("        {agreement}\n");
            }
        }
        text
    }
}

/// Three digits with a unit: "1.23 ms".
fn duration(seconds: f64) -> String {
    let (factor, unit) = match seconds {
        s if s >= 1.0 => (1.0, "s"),
        s if s >= 1e-3 => (1e3, "ms"),
        s if s >= 1e-6 => (1e6, "µs"),
        _ => (1e9, "ns"),
    };
    let value = factor * seconds;
    let digits = [9.995, 99.95].iter().filter(|&&bound| value < bound).count();
    format!("{value:.digits$} {unit}")
}

impl Machine {
    fn here() -> Self {
        let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = text.lines().find_map(|l| l.strip_prefix("model name")?.split_once(": "));
        Self {
            processor: model.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.to_owned()),
            cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_read_well() {
        assert_eq!(duration(1.234e-3), "1.23 ms");
        assert_eq!(duration(0.0456), "45.6 ms");
        assert_eq!(duration(0.1999), "200 ms");
        assert_eq!(duration(12.34), "12.3 s");
        assert_eq!(duration(3.0e-9), "3.00 ns");
    }

    #[test]
    fn every_row_has_a_name_of_its_own_and_its_peers_are_there() {
        let script =
            std::fs::read_to_string(greybox_dev::root().join("dev").join("bench").join("peers.py")).unwrap();
        let rows = rows();
        for (i, row) in rows.iter().enumerate() {
            assert!(rows[..i].iter().all(|r| r.name != row.name), "{}", row.name);
            if let Against::Peers(peers) = &row.against {
                for peer in *peers {
                    assert!(script.contains(&format!("\ndef {}(data):", peer.function)), "{}", peer.function);
                }
            }
        }
    }

    #[test]
    fn the_pinned_list_pins() {
        let list =
            std::fs::read_to_string(greybox_dev::root().join("dev").join("bench").join("requirements.txt"))
                .unwrap();
        for line in list.lines().filter(|l| !l.trim().is_empty() && !l.starts_with('#')) {
            assert!(line.split_once("==").is_some_and(|(n, v)| !n.is_empty() && !v.contains('*')), "{line}");
        }
    }
}
