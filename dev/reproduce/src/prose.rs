//! The numbers in the sentences of the book's page: each is one that was measured, as `fixtures/thesis/prose.json` says, or one that was
//! given.

use std::path::Path;

use anyhow::{Context, Result};
use serde::Deserialize;

use super::Outcome;

/// Which numbers of a page were measured, and which were given.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Prose {
    measured: Vec<Sentence>,
    /// Parts of sentences whose numbers are settings, the thesis's own, or follow by arithmetic.
    given: Vec<String>,
}

/// A part of a sentence.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Sentence {
    /// `{}` stands for a number.
    text: String,
    /// For each number the piece and the name of what it judges.
    values: Vec<(String, String)>,
}

/// A number as a page has it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Written {
    value: f64,
    /// Half of the last digit.
    half: f64,
    has_sign: bool,
}

impl Written {
    /// Whether a value rounds to it; without a sign, whether its size does.
    fn is(self, measured: f64) -> bool {
        let measured = if self.has_sign { measured } else { measured.abs() };
        (measured - self.value).abs() <= self.half * (1.0 + 1e-9)
    }
}

/// What begins with a number: the number, and its length in bytes. `0.51`, `−0.55`, `4·10⁻⁷`.
fn number(text: &str) -> Option<(Written, usize)> {
    let rest = text.strip_prefix(['−', '-']).unwrap_or(text);
    let has_sign = rest.len() < text.len();
    let digits = rest.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(rest.len());
    let plain = rest[..digits].trim_end_matches('.');
    let value: f64 = plain.parse().ok()?;
    let half = 0.5 * 10f64.powi(-(plain.split_once('.').map_or(0, |(_, decimals)| decimals.len()) as i32));
    let mut length = text.len() - rest.len() + plain.len();
    let mut factor = if has_sign { -1.0 } else { 1.0 };
    if let Some(power) = text[length..].strip_prefix("·10") {
        let superscript = |c: char| "⁰¹²³⁴⁵⁶⁷⁸⁹".chars().position(|s| s == c);
        let digits: Vec<usize> = power.trim_start_matches('⁻').chars().map_while(superscript).collect();
        let size = digits.iter().fold(0, |n, d| 10 * n + *d as i32);
        let is_negative = power.starts_with('⁻');
        factor *= 10f64.powi(if is_negative { -size } else { size });
        let signs = usize::from(is_negative);
        length += "·10".len() + power.chars().take(signs + digits.len()).map(char::len_utf8).sum::<usize>();
    }
    Some((Written { value: factor * value, half: half * factor.abs(), has_sign }, length))
}

/// Where a sentence stands in a text (from, to), with its numbers.
fn find(text: &str, sentence: &str) -> Option<(usize, usize, Vec<Written>)> {
    let parts: Vec<&str> = sentence.split("{}").collect();
    let first = parts.first()?;
    text.match_indices(first).find_map(|(from, _)| {
        let mut at = from + first.len();
        let mut numbers = Vec::new();
        for part in &parts[1..] {
            let (written, length) = number(&text[at..])?;
            at += length;
            text[at..].starts_with(part).then_some(())?;
            at += part.len();
            numbers.push(written);
        }
        Some((from, at, numbers))
    })
}

/// A page without its generated tables, in one line.
fn sentences(page: &str) -> String {
    let mut out = String::new();
    let mut rest = page;
    while let Some((before, behind)) = rest.split_once("<!-- Written by") {
        out.push_str(before);
        rest = behind.split_once("<!-- End of the table. -->").map_or("", |(_, after)| after);
    }
    out.push_str(rest);
    out.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Numbers that nothing accounts for, each with what is around it. Those of tables, figures, equations and the like are names.
fn left(text: &str) -> Vec<String> {
    const NAMES: [&str; 10] = [
        "Table",
        "Tables",
        "Figure",
        "Figures",
        "equation",
        "Algorithm",
        "chapter",
        "chapters",
        "section",
        "Equation",
    ];
    let words: Vec<&str> = text.split(' ').collect();
    let mut is_name = false;
    let mut out = Vec::new();
    for (i, word) in words.iter().enumerate() {
        let bare = word.trim_matches(|c: char| !c.is_alphanumeric());
        if NAMES.contains(&bare) {
            is_name = true;
            continue;
        }
        let is_number = bare.chars().all(|c| c.is_ascii_digit() || c == '.') && !bare.is_empty();
        if is_name && (is_number || ["and", "to"].contains(&bare)) {
            continue;
        }
        is_name = false;
        let is_erratum =
            bare.strip_prefix('E').is_some_and(|n| !n.is_empty() && n.chars().all(|c| c.is_ascii_digit()));
        if word.contains(|c: char| c.is_ascii_digit()) && !is_erratum {
            out.push(words[i.saturating_sub(4)..(i + 5).min(words.len())].join(" "));
        }
    }
    out
}

impl Prose {
    /// Reads the file.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(crate) fn read(folder: &Path) -> Result<Prose> {
        let path = folder.join("prose.json");
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        serde_json::from_str(&text).with_context(|| path.display().to_string())
    }

    /// What is wrong with a page: a sentence that it does not have, a number that nothing accounts for, and one that is not what
    /// was `measured` (of a piece, under a name; `None`: not measured in this run).
    pub(crate) fn faults(&self, page: &str, measured: &dyn Fn(&str, &str) -> Option<f64>) -> Vec<String> {
        let mut text = sentences(page);
        let mut faults = Vec::new();
        for sentence in &self.measured {
            let Some((from, to, numbers)) = find(&text, &sentence.text) else {
                faults.push(format!("the page does not say `{}`", sentence.text));
                continue;
            };
            if numbers.len() != sentence.values.len() {
                faults.push(format!("`{}` needs a value for each number", sentence.text));
            }
            for (written, (piece, name)) in numbers.iter().zip(&sentence.values) {
                if let Some(value) = measured(piece, name)
                    && !written.is(value)
                {
                    let says = &text[from..to];
                    faults.push(format!("the page says `{says}`; {piece} measures {value} for `{name}`"));
                }
            }
            text.replace_range(from..to, " ");
        }
        for given in &self.given {
            match text.find(given) {
                Some(from) => text.replace_range(from..from + given.len(), " "),
                None => faults.push(format!("the page does not say `{given}`")),
            }
        }
        let unknown = left(&text);
        faults.extend(
            unknown.into_iter().map(|around| format!("nothing accounts for the number in `{around}`")),
        );
        faults
    }
}

/// What is wrong with the sentences of the page after a run of everything.
///
/// # Errors
/// When the page or the file cannot be read.
pub(crate) fn faults(root: &Path, folder: &Path, page: &str, outcomes: &[Outcome]) -> Result<Vec<String>> {
    let path = root.join("docs").join("src").join(page);
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let measured = |piece: &str, name: &str| {
        let outcome = outcomes.iter().find(|o| o.fixture.id == piece)?;
        outcome.piece.checks.iter().find(|c| c.name == name).map(|c| c.measured)
    };
    Ok(Prose::read(folder)?.faults(&text, &measured))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_as_pages_write_them() {
        let is = |text: &str, value: f64, half: f64, length: usize| {
            let (written, found) = number(text).unwrap();
            assert!((written.value - value).abs() < 1e-12 * value.abs(), "{text}: {written:?}");
            assert!((written.half - half).abs() < 1e-12 * half, "{text}: {written:?}");
            assert_eq!((found, written.has_sign), (length, value < 0.0), "{text}");
        };
        is("0.51 s", 0.51, 0.005, 4);
        is("20. The", 20.0, 0.5, 2);
        is("−0.55;", -0.55, 0.005, 7);
        is("4·10⁻⁷.", 4e-7, 0.5e-7, "4·10⁻⁷".len());
        is("1.5·10⁶", 1.5e6, 0.05e6, "1.5·10⁶".len());
        assert!(number("many").is_none());
    }

    #[test]
    fn a_page_says_what_was_measured_and_no_more() {
        let prose: Prose = serde_json::from_str(
            r#"{"measured": [{"text": "settles in {} s with {} % left", "values": [["A", "time"], ["A", "error"]]}],
                "given": ["a step of 60°"]}"#,
        )
        .unwrap();
        let page = "It settles\nin 0.51 s with −2 % left after a step of 60° (Figures 4.1 and 4.2, E20).\n\
                    <!-- Written by x -->\n| 7 |\n<!-- End of the table. -->\nDone.";
        let of = |time: f64, error: f64| {
            move |piece: &str, name: &str| (piece == "A").then_some(if name == "time" { time } else { error })
        };
        assert_eq!(prose.faults(page, &of(0.5149, -1.6)), Vec::<String>::new());
        assert_eq!(prose.faults(page, &|_, _| None), Vec::<String>::new());
        assert!(prose.faults(page, &of(0.5151, -2.0))[0].contains("A measures 0.5151 for `time`"));
        assert_eq!(prose.faults(page, &of(0.51, 2.0)).len(), 1, "its sign");
        let more = page.replace("Done", "Done in 3 steps");
        assert!(prose.faults(&more, &of(0.51, -2.0))[0].contains("in 3 steps"));
        let less = page.replace("60°", "70°").replace("settles\nin", "rests in");
        assert_eq!(
            prose.faults(&less, &of(0.51, -2.0)).len(),
            4 + 1,
            "two sentences gone, and their numbers"
        );
    }

    /// The page as it stands: whether the values are right shows the whole run.
    #[test]
    fn every_number_of_the_page_is_accounted_for() {
        let root = greybox_dev::root();
        let folder = root.join("fixtures").join("thesis");
        assert_eq!(faults(&root, &folder, super::super::pages::PAGE, &[]).unwrap(), Vec::<String>::new());
        for (piece, name) in Prose::read(&folder).unwrap().measured.iter().flat_map(|s| &s.values) {
            let fixture = super::super::Fixture::read(&folder, piece).unwrap();
            assert!(fixture.bounds.contains_key(name), "{piece}: {name}");
        }
    }
}
