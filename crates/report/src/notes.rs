//! Findings for a reader: what many recordings have in common is said once.

use crate::contract::{Finding, Severity};

/// Most recordings that a place names; of the others it states the number.
const NAMED: usize = 3;

/// One line about the data: what was found of a channel, in however many recordings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Note {
    /// How much it matters.
    pub severity: Severity,
    /// Stable short name of what was found.
    pub code: String,
    /// Where: channel and recordings; empty where it concerns neither.
    pub place: String,
    /// What was found, in plain language, with the figures of the first recording.
    pub message: String,
    /// What to do about it.
    pub help: Option<String>,
}

/// One note for each severity, code and channel, in the order in which they come first.
///
/// Findings about no recording stay apart: they are about the study. Of a group the note tells what was found in its first
/// recording (all of it, where that has more than one such finding, such as both ends of a range) and names the others.
/// Whose the figures are, it says where they are not the same in all.
///
/// ```
/// use greybox_report::contract::{Finding, Severity};
/// let finding = |recording: &str, steps: u8| Finding {
///     severity: Severity::Warning,
///     code: "quantisation".to_owned(),
///     recording: Some(recording.to_owned()),
///     channel: Some("v".to_owned()),
///     message: format!("{steps} steps span the motion."),
///     help: None,
/// };
/// let notes = greybox_report::notes::grouped(&[finding("a.csv", 20), finding("b.csv", 30)]);
/// assert_eq!(notes.len(), 1);
/// assert_eq!(notes[0].place, "v in 2 recordings (a.csv, b.csv)");
/// assert_eq!(notes[0].message, "20 steps span the motion. (Figures of a.csv.)");
/// ```
pub fn grouped(findings: &[Finding]) -> Vec<Note> {
    let mut groups: Vec<Vec<&Finding>> = Vec::new();
    for finding in findings {
        let key = |f: &Finding| (f.severity, f.code.clone(), f.channel.clone());
        let group = groups.iter_mut().find(|group| {
            finding.recording.is_some() && group[0].recording.is_some() && key(group[0]) == key(finding)
        });
        match group {
            Some(group) => group.push(finding),
            None => groups.push(vec![finding]),
        }
    }
    groups.iter().map(|group| note(group)).collect()
}

/// The note of findings of one severity, code and channel; at least one.
fn note(group: &[&Finding]) -> Note {
    let first = group[0];
    let of = |recording: Option<&str>| -> Vec<&str> {
        let own = group.iter().filter(|f| f.recording.as_deref() == recording);
        let mut reported: Vec<&str> = Vec::new();
        for finding in own {
            if !reported.contains(&finding.message.as_str()) {
                reported.push(&finding.message);
            }
        }
        reported
    };
    let mut recordings: Vec<&str> = Vec::new();
    for recording in group.iter().filter_map(|f| f.recording.as_deref()) {
        if !recordings.contains(&recording) {
            recordings.push(recording);
        }
    }
    let messages = of(first.recording.as_deref());
    let mut message = messages.join(" ");
    if let Some(name) = recordings.first()
        && recordings.iter().any(|other| of(Some(other)) != messages)
    {
        message.push_str(&format!(" (Figures of {name}.)"));
    }
    Note {
        severity: first.severity,
        code: first.code.clone(),
        place: place(first.channel.as_deref(), &recordings),
        message,
        help: group.iter().find_map(|f| f.help.clone()),
    }
}

/// A channel and recordings, for the beginning of a line.
fn place(channel: Option<&str>, recordings: &[&str]) -> String {
    let several = match recordings {
        [] => return channel.unwrap_or_default().to_owned(),
        [alone] => {
            let parts: Vec<&str> = [Some(*alone), channel].into_iter().flatten().collect();
            return parts.join(", ");
        }
        several => several,
    };
    let named = several.iter().take(NAMED).copied().collect::<Vec<_>>().join(", ");
    let more = match several.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    let inside = if channel.is_some() { " in " } else { "" };
    format!("{}{inside}{} recordings ({named}{more})", channel.unwrap_or_default(), several.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(code: &str, recording: Option<&str>, channel: Option<&str>, message: &str) -> Finding {
        Finding {
            severity: Severity::Warning,
            code: code.to_owned(),
            recording: recording.map(str::to_owned),
            channel: channel.map(str::to_owned),
            message: message.to_owned(),
            help: Some(format!("help {code}")),
        }
    }

    #[test]
    fn forty_findings_of_two_channels_are_two_notes() {
        let names: Vec<String> = (0..20).map(|k| format!("run{k}.csv")).collect();
        let found: Vec<Finding> = names
            .iter()
            .enumerate()
            .flat_map(|(k, name)| {
                [("u", format!("{k} samples stand out.")), ("y", "Only noise.".to_owned())]
                    .map(|(channel, message)| finding("outliers", Some(name), Some(channel), &message))
            })
            .collect();
        let notes = grouped(&found);
        assert_eq!(notes.len(), 2, "{notes:?}");
        assert_eq!(notes[0].place, "u in 20 recordings (run0.csv, run1.csv, run2.csv and 17 more)");
        assert_eq!(notes[0].message, "0 samples stand out. (Figures of run0.csv.)");
        assert_eq!(notes[0].help.as_deref(), Some("help outliers"));
        assert_eq!(notes[1].message, "Only noise.", "the same in all: nobody's figures");
    }

    #[test]
    fn what_differs_in_code_channel_or_severity_stays_apart() {
        let a = finding("clipping", Some("a"), Some("y"), "m");
        let mut grave = finding("clipping", Some("b"), Some("y"), "m");
        grave.severity = Severity::Error;
        let found = [
            a.clone(),
            grave,
            finding("outliers", Some("b"), Some("y"), "m"),
            finding("clipping", Some("b"), Some("u"), "m"),
            finding("clipping", Some("b"), None, "m"),
        ];
        assert_eq!(grouped(&found).len(), 5);
        assert_eq!(grouped(&[a])[0].place, "a, y");
        assert!(grouped(&[]).is_empty());
    }

    #[test]
    fn findings_of_the_study_are_never_merged() {
        let found = [finding("hold", None, Some("u"), "one"), finding("hold", None, Some("u"), "other")];
        let notes = grouped(&found);
        assert_eq!(notes.iter().map(|n| n.message.as_str()).collect::<Vec<_>>(), ["one", "other"]);
        assert_eq!(notes[0].place, "u");
        assert_eq!(grouped(&[finding("limit", None, None, "m")])[0].place, "");
    }

    #[test]
    fn both_ends_of_a_range_are_told() {
        let found = [
            finding("clipping", Some("a"), Some("y"), "Low."),
            finding("clipping", Some("a"), Some("y"), "High."),
            finding("clipping", Some("b"), Some("y"), "High."),
            finding("short_piece", Some("a"), None, "m"),
            finding("short_piece", Some("b"), None, "m"),
        ];
        let notes = grouped(&found);
        assert_eq!(notes.len(), 2);
        assert_eq!(notes[0].place, "y in 2 recordings (a, b)");
        assert_eq!(notes[0].message, "Low. High. (Figures of a.)");
        assert_eq!(notes[1].place, "2 recordings (a, b)");
    }
}
