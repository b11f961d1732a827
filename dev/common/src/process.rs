//! Running a command while watching its time and memory.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

/// Where cargo builds.
pub fn target(root: &Path) -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), |d| root.join(d))
}

/// Builds `greybox` and names it.
///
/// # Errors
/// When it does not build.
pub fn build(root: &Path) -> Result<PathBuf> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo)
        .args(["build", "--release", "--locked", "--package", "greybox-cli"])
        .current_dir(root)
        .status()
        .context("cargo could not be started")?;
    if !status.success() {
        bail!("greybox does not build");
    }
    let binary = target(root).join("release").join(format!("greybox{}", std::env::consts::EXE_SUFFIX));
    if !binary.is_file() {
        bail!("the build left no {}", binary.display());
    }
    Ok(binary)
}

/// How a command ran.
#[derive(Debug, Clone)]
pub struct Measured {
    /// `None` when it was stopped at the time limit.
    pub status: Option<ExitStatus>,
    /// Wall-clock time, s.
    pub seconds: f64,
    /// Largest resident set, bytes: the kernel's high-water mark, read every 10 ms, at first every
    /// 1 ms (what is added after the last reading goes unseen). `None` where `/proc` does not exist.
    pub peak_bytes: Option<u64>,
    /// CPU time of all its threads, s, as of the last reading. `None` where `/proc` does not exist.
    pub cpu: Option<f64>,
}

/// Runs a command to its end or to `limit`, its output in the files `stdout.txt` and `stderr.txt` of
/// `logs`.
///
/// # Errors
/// When the command cannot be started, or the files cannot be written.
pub fn run(command: &mut Command, logs: &Path, limit: Duration) -> Result<Measured> {
    let create = |name: &str| {
        let path = logs.join(name);
        File::create(&path).with_context(|| format!("{} cannot be written", path.display()))
    };
    let program = command.get_program().to_string_lossy().into_owned();
    command.stdin(Stdio::null()).stdout(create("stdout.txt")?).stderr(create("stderr.txt")?);
    let start = Instant::now();
    let mut child = command.spawn().with_context(|| format!("{program} could not be started"))?;
    let [status_file, times_file] = ["status", "stat"].map(|f| format!("/proc/{}/{f}", child.id()));
    let (mut peak_bytes, mut cpu) = (None, None);
    loop {
        if let Ok(text) = std::fs::read_to_string(&status_file) {
            peak_bytes = peak_bytes.max(high_water_mark(&text));
        }
        if let Ok(text) = std::fs::read_to_string(&times_file) {
            cpu = cpu_time(&text).or(cpu);
        }
        if let Some(status) = child.try_wait()? {
            return Ok(Measured {
                status: Some(status),
                seconds: start.elapsed().as_secs_f64(),
                peak_bytes,
                cpu,
            });
        }
        if start.elapsed() > limit {
            child.kill()?;
            child.wait()?;
            return Ok(Measured { status: None, seconds: start.elapsed().as_secs_f64(), peak_bytes, cpu });
        }
        // A short run is watched more closely.
        let pause = if start.elapsed().as_millis() < 200 { 1 } else { 10 };
        std::thread::sleep(Duration::from_millis(pause));
    }
}

/// User and system time of the text of `/proc/PID/stat`, s. Its unit is 10 ms on every Linux that Rust runs on.
fn cpu_time(stat: &str) -> Option<f64> {
    // The name of the program, in parentheses, may hold anything.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<f64>().ok();
    Some(0.01 * (next()? + next()?)).filter(|t| *t > 0.0)
}

/// `VmHWM` of the text of `/proc/PID/status`, bytes.
fn high_water_mark(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_high_water_mark_is_read() {
        assert_eq!(high_water_mark("Name:\tx\nVmHWM:\t    2048 kB\nVmRSS:\t 4 kB\n"), Some(2048 * 1024));
        assert_eq!(high_water_mark("Name:\tx\n"), None);
    }

    #[test]
    fn the_cpu_time_is_read_whatever_the_program_is_called() {
        let stat = "7 (a) b) R 1 2 3 4 5 6 7 8 9 10 150 25 0 0";
        assert_eq!(cpu_time(stat), Some(1.75));
        assert_eq!(cpu_time("7 (x) R 1"), None);
    }

    #[cfg(unix)]
    #[test]
    fn a_command_is_timed_watched_and_stopped() {
        let logs = tempfile::tempdir().unwrap();
        let shell = |script: &str, limit: f64| {
            let mut command = Command::new("sh");
            run(command.args(["-c", script]), logs.path(), Duration::from_secs_f64(limit)).unwrap()
        };
        let done = shell("sleep 0.1; echo out; echo err >&2; exit 3", 20.0);
        assert_eq!(done.status.unwrap().code(), Some(3));
        assert!(done.seconds >= 0.1, "{}", done.seconds);
        if Path::new("/proc/self/status").exists() {
            assert!(done.peak_bytes.unwrap() > 0);
        }
        assert_eq!(std::fs::read_to_string(logs.path().join("stdout.txt")).unwrap(), "out\n");
        assert_eq!(std::fs::read_to_string(logs.path().join("stderr.txt")).unwrap(), "err\n");
        assert!(shell("exec sleep 20", 0.2).status.is_none());
    }
}
