//! `--log`: what is being done, on standard error, and what it cost.
#![allow(clippy::disallowed_methods, reason = "it tells times, in no result")]

use std::fmt::Write as _;
use std::io::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use cpu_time::ProcessTime;

/// Whether stages are reported, set once before a command runs.
static WANTED: AtomicBool = AtomicBool::new(false);

/// Asks for the log.
pub(crate) fn want() {
    WANTED.store(true, Ordering::Relaxed);
}

/// Whether it was asked for.
pub(crate) fn is_wanted() -> bool {
    WANTED.load(Ordering::Relaxed)
}

/// Tells every stage as it begins and, when dropped, what each sort of them cost.
#[derive(Debug)]
pub(crate) struct Log {
    start: Instant,
    stages: Mutex<Stages>,
}

/// Stages by their sort, in the order in which they first came.
#[derive(Debug, Default)]
struct Stages {
    running: Option<(String, Instant, ProcessTime)>,
    costs: Vec<Cost>,
}

#[derive(Debug, PartialEq)]
struct Cost {
    sort: String,
    times: usize,
    wall: f64,
    cpu: f64,
}

impl Log {
    pub(crate) fn new() -> Log {
        Log { start: Instant::now(), stages: Mutex::default() }
    }

    /// A stage begins, and the one before ends.
    pub(crate) fn stage(&self, what: &str) {
        tell(&format!("{:9.2} s  {what}\n", self.start.elapsed().as_secs_f64()));
        let mut stages = self.stages.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        stages.end();
        stages.running = Some((sort(what), Instant::now(), ProcessTime::now()));
    }

    /// Something came out while a stage is running.
    pub(crate) fn fact(&self, what: &str) {
        tell(&format!("{:9.2} s    {what}\n", self.start.elapsed().as_secs_f64()));
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        let stages = self.stages.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
        stages.end();
        tell(&format!("{:9.2} s  done\n\n{}", self.start.elapsed().as_secs_f64(), table(&stages.costs)));
    }
}

/// On standard error. Where that is full or closed nobody reads the log, and the work goes on.
fn tell(text: &str) {
    let _ = std::io::stderr().lock().write_all(text.as_bytes());
}

impl Stages {
    fn end(&mut self) {
        let Some((sort, wall, cpu)) = self.running.take() else { return };
        let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu.elapsed().as_secs_f64());
        match self.costs.iter_mut().find(|c| c.sort == sort) {
            Some(cost) => {
                cost.times += 1;
                cost.wall += wall;
                cost.cpu += cpu;
            }
            None => self.costs.push(Cost { sort, times: 1, wall, cpu }),
        }
    }
}

/// What a stage is called without its numbers: `screening 63 candidates` is `screening`.
fn sort(what: &str) -> String {
    let end = what.find(|c: char| c.is_ascii_digit()).unwrap_or(what.len());
    what[..end].trim_end_matches([' ', ',']).to_owned()
}

fn table(costs: &[Cost]) -> String {
    let widest = costs.iter().map(|c| c.sort.chars().count()).max().unwrap_or(0).max("stage".len());
    let total: f64 = costs.iter().map(|c| c.wall).sum();
    let mut text = format!("{:widest$}  times  time in s   share  CPU time in s\n", "stage");
    for Cost { sort, times, wall, cpu } in costs {
        let share = 100.0 * wall / total.max(f64::MIN_POSITIVE);
        let _ = writeln!(text, "{sort:widest$}  {times:5}  {wall:9.2}  {share:4.0} %  {cpu:13.2}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_of_one_sort_are_one_line() {
        assert_eq!(sort("screening 63 candidates (2 found so far)"), "screening");
        assert_eq!(sort("pass 1, 20000 samples"), "pass");
        assert_eq!(sort("intervals and resampled choices"), "intervals and resampled choices");
        let mut stages = Stages::default();
        for what in ["screening 3 candidates", "fitting the best 2", "screening 4 candidates"] {
            stages.end();
            stages.running = Some((sort(what), Instant::now(), ProcessTime::now()));
        }
        stages.end();
        stages.end();
        let found: Vec<(&str, usize)> = stages.costs.iter().map(|c| (c.sort.as_str(), c.times)).collect();
        assert_eq!(found, [("screening", 2), ("fitting the best", 1)]);
    }

    #[test]
    fn shares_add_up() {
        let cost = |sort: &str, wall: f64| Cost { sort: sort.into(), times: 1, wall, cpu: 2.0 * wall };
        let text = table(&[cost("a", 3.0), cost("fitting", 1.0)]);
        assert!(text.contains("a            1       3.00    75 %           6.00\n"), "{text}");
    }
}
