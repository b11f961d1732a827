//! What the answer of `greybox demo` must be.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use clap::ValueEnum;
use greybox_recording::{Recording, read_csv};
use greybox_report::Report;
use greybox_report::contract::Verdict;
use serde_json::Value;

use greybox_dev::figure::{Axis, Plot, Series, Style};
use greybox_dev::{Ending, book, process, readme};

/// A machine of `greybox demo`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Machine {
    /// The cart on a spring.
    Cart,
    /// The flexible link.
    Link,
}

impl Machine {
    /// Stem of the names of its files.
    fn stem(self) -> &'static str {
        match self {
            Machine::Cart => "cart",
            Machine::Link => "rotary_link",
        }
    }

    /// Marker of its answer in the README.
    fn marker(self) -> &'static str {
        match self {
            Machine::Cart => "main answer",
            Machine::Link => "link answer",
        }
    }

    /// The channel whose simulations are compared.
    fn channel(self) -> &'static str {
        match self {
            Machine::Cart => "x",
            Machine::Link => "theta",
        }
    }

    /// Level of its Coulomb friction, N or N m.
    fn friction(self) -> f64 {
        match self {
            Machine::Cart => 0.8,
            Machine::Link => 0.01478,
        }
    }
}

/// How near the level of the friction is found.
const NEAR: f64 = 0.01;
/// Held-out error over the noise.
const HELD_OUT: f64 = 1.2;

/// Checks what `greybox demo MACHINE --out OUT` printed (into the file `answer`) and left: the README shows this answer, and
/// the files simulate as well as the report says. Draws the machine's figure of these simulations, if it is to be written.
///
/// # Errors
/// What is not so, in words.
pub(crate) fn check(
    root: &Path,
    machine: Machine,
    answer: &Path,
    out: &Path,
    write_docs: bool,
) -> Result<Ending> {
    let text = |path: &Path| {
        std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))
    };
    is_shown(&text(answer)?, &text(&root.join("README.md"))?, machine.marker())?;
    let stem = machine.stem();
    let [model, test, train] = [".toml", "_test.csv", "_train.csv"].map(|end| format!("{stem}{end}"));
    let mut expected = ["improved.toml", "report.html", "report.json", &model, &test, &train];
    expected.sort_unstable();
    let mut files: Vec<String> = std::fs::read_dir(out)
        .with_context(|| format!("{} cannot be read", out.display()))?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<Result<_>>()?;
    files.sort();
    ensure!(files == expected, "{} holds {files:?} in place of {expected:?}", out.display());

    let report = Report::from_json(&text(&out.join("report.json"))?)?;
    ensure!(report.verdict == Verdict::MissingPhysics, "the verdict is {:?}", report.verdict);
    let Some(first) = report.mechanisms.first() else { bail!("no mechanism is named") };
    ensure!(first.kind == "coulomb_friction", "{} is named first", first.kind);
    let level = first.parameters.get("fc").context("the friction has no fc")?.value;
    let friction = machine.friction();
    ensure!((level / friction - 1.0).abs() < NEAR, "fc = {level}; the machine has {friction}");
    for (channel, score) in &report.fit.holdout.improved {
        let floor = report.noise_floor.get(channel).with_context(|| format!("no noise of {channel}"))?;
        ensure!(score.nrmse < HELD_OUT * floor, "{channel}: {} held out; the noise is {floor}", score.nrmse);
    }
    let is_all = report.candidates.is_empty() && report.mechanisms.len() == 1;
    ensure!(machine == Machine::Link || is_all, "more than the friction is found in the cart");
    let improved = text(&out.join("improved.toml"))?;
    for name in report.candidates.iter().flat_map(|candidate| candidate.parameters.keys()) {
        let line = improved.lines().find(|line| line.split(" = ").next() == Some(name));
        let said = line.is_some_and(|line| line.contains("proposed by greybox, not named"));
        ensure!(said, "improved.toml does not say that {name} is only proposed");
    }

    let command = process::build(root)?;
    let scratch = process::target(root).join("demo.csv");
    let (held_out, channel) = (&report.fit.holdout, machine.channel());
    let mut simulated = Vec::new();
    for (model, said) in [("improved.toml", &held_out.improved), (&model, &held_out.nominal)] {
        let said = said.get(channel).with_context(|| format!("no score of {channel} with {model}"))?.nrmse;
        let run = Command::new(&command)
            .arg("simulate")
            .args([model, &test].map(|name| out.join(name)))
            .args(["--json", "--out"])
            .arg(&scratch)
            .output()
            .context("greybox could not be started")?;
        ensure!(run.status.success(), "{model}: {}", String::from_utf8_lossy(&run.stderr));
        let run: Value = serde_json::from_slice(&run.stdout)?;
        let nrmse = run["fit"][channel]["nrmse"].as_f64().context("a simulation without a score")?;
        ensure!(
            (nrmse / said - 1.0).abs() < 0.05,
            "{model} simulates {channel} to {nrmse}; the report says {said}"
        );
        simulated.push(read_csv(&scratch)?);
    }
    if write_docs {
        let measured = read_csv(out.join(&test))?;
        let [improved, nominal] = &simulated[..] else { bail!("two simulations are drawn") };
        book::put_file(root, &format!("demo-{stem}.svg"), &figure(machine, &measured, nominal, improved)?)?;
    }
    println!("the answer is the README's, and its files simulate as the report says");
    Ok(Ending::Done)
}

/// The recording that was held out, as measured and as two models simulate it.
fn figure(
    machine: Machine,
    measured: &Recording,
    nominal: &Recording,
    improved: &Recording,
) -> Result<String> {
    let (what, axis) = match machine {
        Machine::Cart => ("The cart's position", "x in m"),
        Machine::Link => ("The hub's angle", "θ in rad"),
    };
    // Every tenth sample shows the motion.
    let series = |label: &str, style: Style, of: &Recording| -> Result<Series> {
        let channel = machine.channel();
        let values = &of.channel(channel).with_context(|| format!("no channel {channel}"))?.values;
        let points = of.time.iter().zip(values).step_by(10).map(|(t, v)| [*t, *v]).collect();
        Ok(Series::new(label, style, points))
    };
    let plot = Plot {
        alt: format!(
            "{what} in the held-out recording: measured, by the model as given, and by the improved model"
        ),
        x: Axis::linear("time in s"),
        y: Axis::linear(axis),
        series: vec![
            series("model as given", Style::Dashed, nominal)?,
            series("measured", Style::Points, measured)?,
            series("improved model", Style::Line, improved)?,
        ],
    };
    plot.to_svg().context("nothing to draw")
}

/// The README shows this answer; its last digits may be another machine's.
fn is_shown(answer: &str, readme: &str, marker: &str) -> Result<()> {
    let shown = readme::block_after(readme, marker)?;
    ensure!(shown.lines().count() > 5, "the README shows hardly anything: {shown}");
    let without_digits = |text: &str| text.replace(|c: char| c.is_ascii_digit(), "");
    ensure!(
        without_digits(answer).contains(&without_digits(&shown)),
        "the README shows another answer than\n{answer}"
    );
    ensure!(!answer.contains("limit of work"), "the demo ends at its limit of work");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::is_shown;

    #[test]
    fn an_answer_may_differ_from_the_readme_in_its_digits_alone() {
        let readme = |shown: &str| format!("# x\n<!-- main answer -->\n```text\n{shown}```\n");
        let shown = "a 1.5\nb 2\nc\nd\ne\nf 3 %\n";
        assert!(
            is_shown("before\na 1.4\nb 7\nc\nd\ne\nf 9 %\nafter\n", &readme(shown), "main answer").is_ok()
        );
        for other in ["", "a 1.5\nb 2\nc\nd\ne\ng 3 %\n", "a 1.5\nb 2\nc\nd\ne\nf 3 %\nlimit of work\n"] {
            assert!(is_shown(other, &readme(shown), "main answer").is_err(), "{other}");
        }
        assert!(is_shown("a", &readme("a\n"), "main answer").is_err());
        assert!(is_shown(shown, "# x\n", "main answer").is_err());
    }
}
