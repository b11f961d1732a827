//! What a check has to say: severity, sentence, fix, number; numbers and lists in sentences.

use serde::Serialize;
use std::fmt;

/// How much a [`Finding`] matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// A fact worth knowing; nothing needs fixing.
    Info,
    /// Results may suffer; the fix is worth the trouble.
    Warning,
    /// Results from this channel or recording cannot be trusted.
    Problem,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Problem => "problem",
        })
    }
}

/// One thing found in a recording, in a plain sentence, with the number behind it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// Stable machine name of the check: `sampling`, `jitter`, `gap`, `short_piece`, `missing`, `clipping`,
    /// `quantisation`, `outliers`, `flat`, `excitation`, `noise`, `record_length`, `bandwidth`, `delay`,
    /// `constant_input`, `clock_offset`, `unknown_channel`; of files that are no CSV `time_column`, `left_out`, `clocks`; beside a
    /// model `nominal_diverges`, `nominal_sign`, `nominal_size`, `input_noise`.
    pub code: &'static str,
    /// The channel it is about; `None` when it concerns the whole recording.
    pub channel: Option<String>,
    /// What was found, as a sentence for an engineer.
    pub message: String,
    /// What to do about it, where something can be done.
    pub help: Option<String>,
    /// The number behind the sentence, in `unit`.
    pub value: Option<f64>,
    /// Unit of `value`; `None` where `value` is a count, a ratio, or in a channel unit that the file does not
    /// state.
    pub unit: Option<String>,
}

impl Finding {
    /// A finding about the whole recording with no fix and no number.
    pub fn new(severity: Severity, code: &'static str, message: impl Into<String>) -> Self {
        Self { severity, code, channel: None, message: message.into(), help: None, value: None, unit: None }
    }

    /// Says which channel it is about.
    #[must_use]
    pub fn on(mut self, channel: &str) -> Self {
        self.channel = Some(channel.to_owned());
        self
    }

    /// Adds what to do about it.
    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }

    /// Adds the number behind the sentence and its unit.
    #[must_use]
    pub fn value(mut self, value: f64, unit: Option<&str>) -> Self {
        self.value = Some(value);
        self.unit = unit.map(str::to_owned);
        self
    }
}

/// `warning [clipping] y: message Help: …`, one line.
impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} [{}] ", self.severity, self.code)?;
        if let Some(channel) = &self.channel {
            write!(f, "{channel}: ")?;
        }
        f.write_str(&self.message)?;
        if let Some(help) = &self.help {
            write!(f, " Help: {help}")?;
        }
        Ok(())
    }
}

/// A number for a sentence: four significant digits, exponent only where it helps reading.
pub(crate) fn number(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let exponent = x.abs().log10().floor();
    if !(-4.0..6.0).contains(&exponent) {
        let text = format!("{x:.3e}");
        let (mantissa, power) = text.split_once('e').unwrap_or((&text, "0"));
        return format!("{}e{power}", trim_zeros(mantissa));
    }
    let decimals = (3.0 - exponent).max(0.0) as usize;
    trim_zeros(&format!("{x:.decimals$}")).to_owned()
}

fn trim_zeros(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

/// A number with its unit, where the unit is known.
pub(crate) fn quantity(x: f64, unit: Option<&str>) -> String {
    match unit {
        Some(unit) => format!("{} {unit}", number(x)),
        None => number(x),
    }
}

/// Most variables or columns that a sentence names.
const MOST_LISTED: usize = 8;

/// A list for a sentence, cut where it gets long.
pub fn listed(mut all: Vec<String>) -> String {
    if all.len() > MOST_LISTED {
        let more = all.len() - MOST_LISTED;
        all.truncate(MOST_LISTED);
        all.push(format!("{more} more"));
    }
    all.join(", ")
}

/// Numbers in increasing order in words: `0 … 49, 51`.
pub(crate) fn in_words(numbers: &[i64]) -> String {
    let runs = numbers.chunk_by(|a, b| b.wrapping_sub(*a) == 1);
    let words = runs.flat_map(|run| match run {
        [first, .., last] if run.len() > 2 => vec![format!("{first} … {last}")],
        few => few.iter().map(i64::to_string).collect(),
    });
    match numbers.is_empty() {
        true => "none".to_owned(),
        false => listed(words.collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_told_in_runs() {
        assert_eq!(in_words(&[]), "none");
        assert_eq!(in_words(&[3]), "3");
        assert_eq!(in_words(&[-1, 0, 4, 5, 6, 9]), "-1, 0, 4 … 6, 9");
        assert_eq!(in_words(&[i64::MIN, i64::MAX]), format!("{}, {}", i64::MIN, i64::MAX));
    }

    #[test]
    fn numbers_read_well() {
        for (x, text) in [
            (0.0, "0"),
            (1000.0, "1000"),
            (610.3516, "610.4"),
            (0.001, "0.001"),
            (1.234_56e-7, "1.235e-7"),
            (-0.5, "-0.5"),
            (2.0e9, "2e9"),
            (123_456.7, "123457"),
        ] {
            assert_eq!(number(x), text);
        }
    }

    #[test]
    fn serialises_with_stable_names() {
        let finding = Finding::new(Severity::Warning, "clipping", "m").on("y").value(2.0, Some("V"));
        let json = serde_json::to_string(&finding).unwrap();
        assert!(json.contains(r#""severity":"warning","code":"clipping","channel":"y""#), "{json}");
        assert!(Severity::Info < Severity::Warning && Severity::Warning < Severity::Problem);
    }
}
