//! Instructions of one call of every row, counted by valgrind: the same on a busy machine and an idle one.
//!
//! `cargo xtask bench --instructions` runs one process per row under callgrind, which counts within
//! [`counted`] only. Valgrind's processor has no AVX-512, so that the counts are those of AVX2 on every machine.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

use super::case::{Answer, Case, Row};

/// By how much a count may grow before it is a regression, and shrink before the file should be written anew:
/// libraries of the system (sin, memcpy) differ that much.
const TOLERANCE: f64 = 0.05;

/// Rows whose one call takes minutes under valgrind, or that measure threads.
const LEFT_OUT: [&str; 3] = ["diagnosis", "gram_two_cores", "screening"];

/// Name of a row → instructions.
type Counts = BTreeMap<String, u64>;

/// Where the counts of the last accepted change are.
fn file(root: &Path) -> PathBuf {
    root.join("dev").join("bench").join("instructions.json")
}

/// Counts all rows, or those of `only`, and holds them against the file; `write` writes it anew.
///
/// # Errors
/// Without valgrind, where a row fails, or where the file lacks a row.
pub(crate) fn run(root: &Path, target: &Path, rows: &[Row], only: &[String], write: bool) -> Result<bool> {
    let wanted =
        |r: &&Row| !LEFT_OUT.contains(&r.name) && (only.is_empty() || only.iter().any(|n| n == r.name));
    let folder = target.join("bench");
    std::fs::create_dir_all(&folder)?;
    let program = std::env::current_exe()?;
    let mut found = Counts::new();
    for row in rows.iter().filter(wanted) {
        found.insert(row.name.to_owned(), count(&program, &folder, row.name).context(row.name)?);
    }
    let path = file(root);
    if write {
        std::fs::write(&path, serde_json::to_string_pretty(&found)? + "\n")
            .with_context(|| format!("{} cannot be written", path.display()))?;
        return Ok(true);
    }
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("{} cannot be read; make it with --write", path.display()))?;
    let before: Counts = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    let mut good = true;
    for (name, now) in &found {
        let verdict = judge(before.get(name).copied(), *now);
        good &= verdict.is_ok();
        let (Ok(words) | Err(words)) = verdict;
        println!("{name:<16} {now:>14}  {words}");
    }
    Ok(good)
}

/// What a count is, beside the one before.
fn judge(before: Option<u64>, now: u64) -> Result<String, String> {
    let Some(before) = before else {
        return Err("not in dev/bench/instructions.json: run with --write".into());
    };
    let change = now as f64 / before as f64 - 1.0;
    let percent = format!("{:+.1} %", 100.0 * change);
    if change > TOLERANCE {
        Err(format!("{percent}: SLOWER; help it, or accept it with --write and say why"))
    } else if change < -TOLERANCE {
        Ok(format!("{percent}: faster; keep it with --write"))
    } else {
        Ok(percent)
    }
}

fn count(program: &Path, folder: &Path, row: &str) -> Result<u64> {
    let out = folder.join(format!("callgrind.{row}"));
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--collect-atstart=no", "--toggle-collect=*instructions::counted*"])
        .arg(format!("--callgrind-out-file={}", out.display()))
        .arg(program)
        .args(["bench", "--count-one", row])
        .output()
        .context("valgrind could not be started; install it (Debian: sudo apt-get install valgrind)")?;
    let text = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!("the run under valgrind failed: {}", text.trim());
    }
    // What a process writes is large, and only its sum is wanted.
    let _ = std::fs::remove_file(&out);
    collected(&text).with_context(|| format!("valgrind counted nothing: {}", text.trim()))
}

/// "==1== Collected : 123" of valgrind's words; nothing counted is nothing.
fn collected(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|l| l.split_once("Collected :"))?.1;
    line.trim().parse().ok().filter(|n| *n > 0)
}

/// One row in this process, on this thread: prepared, warmed up, counted.
///
/// # Errors
/// Where the row fails.
pub(crate) fn one(row: &Row) -> Result<()> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build()?;
    pool.install(|| {
        let mut case = (row.make)()?;
        (case.work)()?;
        counted(&mut case).map(drop)
    })
}

#[inline(never)]
fn counted(case: &mut Case) -> Result<Answer> {
    (case.work)()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_beyond_the_tolerance_is_a_regression() {
        assert!(judge(Some(1000), 1049).is_ok_and(|w| w == "+4.9 %"));
        assert!(judge(Some(1000), 1051).is_err_and(|w| w.contains("SLOWER")));
        assert!(judge(Some(1000), 900).is_ok_and(|w| w.contains("--write")));
        assert!(judge(None, 900).is_err());
    }

    #[test]
    fn valgrinds_sum_is_read() {
        assert_eq!(collected("==7== Events    : Ir\n==7== Collected : 12345\n"), Some(12_345));
        assert_eq!(collected("==7== Collected : 0\n"), None);
        assert_eq!(collected("nothing"), None);
    }

    #[test]
    fn every_row_has_its_count() {
        let text = std::fs::read_to_string(file(&greybox_dev::root())).unwrap();
        let counts: Counts = serde_json::from_str(&text).unwrap();
        let rows = super::super::rows();
        let names: Vec<&str> = rows.iter().map(|r| r.name).filter(|n| !LEFT_OUT.contains(n)).collect();
        assert!(counts.keys().all(|n| names.contains(&n.as_str())));
        assert_eq!(counts.len(), names.len());
    }
}
