//! A case: what another needs to see why a command did what it did, with the recordings or without one value of them.

use std::collections::HashSet;

use greybox_recording::{Channel, Finding, Recording};
use serde_json::{Value, json};

/// Most significant digits of a number that may be a value of a recording.
const DIGITS: usize = 3;
/// Significant digits by which values are distinguished.
const DISTINCT_DIGITS: usize = 12;

/// What is known of a recording without its values: sizes, sampling, ranges to two digits, health.
pub fn statistics(recording: &Recording, findings: &[Finding]) -> Value {
    let lengths: Vec<usize> = recording.pieces.iter().map(|p| p.len).collect();
    let dt = recording.pieces.first().map(|p| p.dt);
    let duration = recording.time.first().zip(recording.time.last()).map(|(first, last)| last - first);
    let channels: Vec<Value> = recording.channels.iter().map(channel).collect();
    json!({
        "rows": recording.time.len(),
        "duration_s": duration,
        "step_s": dt,
        "rate_hz": dt.map(|dt| 1.0 / dt),
        "pieces": lengths,
        "channels": channels,
        "findings": findings,
    })
}

fn channel(channel: &Channel) -> Value {
    let missing = channel.values.iter().filter(|v| v.is_nan()).count();
    json!({
        "name": channel.name,
        "unit": channel.unit,
        "missing": missing,
        "range": range(&channel.values),
    })
}

/// Two numbers of two digits that hold all values between them.
fn range(values: &[f64]) -> Option<[f64; 2]> {
    let low = values.iter().copied().fold(f64::NAN, f64::min);
    let high = values.iter().copied().fold(f64::NAN, f64::max);
    let size = low.abs().max(high.abs());
    if size.is_nan() {
        return None;
    }
    if size == 0.0 {
        return Some([0.0, 0.0]);
    }
    let power = size.log10().floor() as i32 - 1;
    // Read from decimals, so that no digits come of the multiplication.
    let decimal = |steps: f64| format!("{steps:.0}e{power}").parse().unwrap_or(f64::NAN);
    let step = 10f64.powi(power);
    Some([decimal((low / step).floor()), decimal((high / step).ceil())])
}

/// The values of recordings, to know them again in a text in whatever power of ten.
#[derive(Debug, Default)]
pub struct Values(HashSet<u64>);

impl Values {
    /// Those of these recordings. Times are none: the step of the sampling may be stated.
    pub fn of<'a>(recordings: impl IntoIterator<Item = &'a Recording>) -> Values {
        let values = recordings.into_iter().flat_map(|r| r.channels.iter().flat_map(|c| &c.values));
        Values(values.filter(|v| v.is_finite() && **v != 0.0).map(|v| digits(*v)).collect())
    }

    /// The text with every number that is a value of a recording rounded to three digits.
    pub fn taken_out_of(&self, text: &str) -> String {
        let mut out = String::with_capacity(text.len());
        let mut rest = text;
        while let Some(start) = rest.find(|c: char| c.is_ascii_digit()) {
            let named = rest[..start].ends_with(|c: char| c.is_alphanumeric() || c == '_');
            let number = &rest[start..start + length(&rest[start..])];
            out.push_str(&rest[..start]);
            match number.parse::<f64>() {
                Ok(value) if !named && significant(number) > DIGITS && self.0.contains(&digits(value)) => {
                    out.push_str(
                        &format!("{:.*e}", DIGITS - 1, value)
                            .parse::<f64>()
                            .map_or_else(|_| "0".to_owned(), |rounded| rounded.to_string()),
                    );
                }
                _ => out.push_str(number),
            }
            rest = &rest[start + number.len()..];
        }
        out.push_str(rest);
        out
    }
}

/// The leading digits of a number as a whole number, whatever its sign and power of ten.
fn digits(value: f64) -> u64 {
    let text = format!("{:.*e}", DISTINCT_DIGITS - 1, value.abs());
    let mantissa = text.split('e').next().unwrap_or_default();
    mantissa.bytes().filter(u8::is_ascii_digit).fold(0, |n, digit| 10 * n + u64::from(digit - b'0'))
}

/// Significant digits of a number as written.
fn significant(number: &str) -> usize {
    let mantissa = number.split(['e', 'E']).next().unwrap_or_default();
    let digits: String = mantissa.chars().filter(char::is_ascii_digit).collect();
    digits.trim_matches('0').len()
}

/// Length of the number that a text begins with: digits, perhaps a point and more digits, perhaps a power of ten.
fn length(text: &str) -> usize {
    let run = |from: usize| text[from..].bytes().take_while(u8::is_ascii_digit).count();
    let mut end = run(0);
    if text[end..].starts_with('.') && run(end + 1) > 0 {
        end += 1 + run(end + 1);
    }
    let power = text[end..].strip_prefix(['e', 'E']);
    let sign = power.map_or(0, |p| usize::from(p.starts_with(['+', '-'])));
    if power.is_some() && run(end + 1 + sign) > 0 {
        end += 1 + sign + run(end + 1 + sign);
    }
    end
}

/// What an error says, without what it quotes of a recording that could not be read: quotations and numbers are masked.
pub fn masked(message: &str) -> String {
    let mut out = String::with_capacity(message.len());
    for (k, part) in message.split('`').enumerate() {
        match k % 2 {
            1 => out.push_str("`…`"),
            _ => out.extend(part.chars().map(|c| if c.is_ascii_digit() { '#' } else { c })),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(values: Vec<f64>) -> Recording {
        let time = (0..values.len()).map(|k| k as f64 * 0.01).collect();
        let channel = Channel { name: "x".into(), unit: Some("mm".into()), values };
        Recording::from_columns("r.csv", time, vec![channel]).unwrap()
    }

    #[test]
    fn values_are_known_again_in_any_power_of_ten() {
        let values = Values::of([&recording(vec![12.3456, -0.5, 7.0, 1.25e-7, 2048.0, 3.0, 4.0, 5.0])]);
        for (text, expected) in [
            ("the largest is 12.3456 mm", "the largest is 12.3 mm"),
            ("[-12.3456,0.0123456,1.23456e-2]", "[-12.3,0.0123,0.0123]"),
            ("0.012345600000000001", "0.0123"),
            ("2048 of 2049", "2050 of 2049"),
            ("12.34567 and 12.345", "12.34567 and 12.345"),
            ("x2048 and run_2048", "x2048 and run_2048"),
            ("0.5, 5, 125 and 7.00", "0.5, 5, 125 and 7.00"),
            ("ends in 12.", "ends in 12."),
            ("1e", "1e"),
        ] {
            assert_eq!(values.taken_out_of(text), expected);
        }
    }

    #[test]
    fn ranges_hold_the_values_and_are_none() {
        assert_eq!(range(&[12.3456, -0.7, f64::NAN]), Some([-1.0, 13.0]));
        assert_eq!(range(&[-0.00128, 0.00031]), Some([-0.0013, 0.0004]));
        assert_eq!(range(&[0.0, 0.0]), Some([0.0, 0.0]));
        assert_eq!(range(&[f64::NAN]), None);
    }

    #[test]
    fn an_error_keeps_its_words_and_loses_its_values() {
        assert_eq!(masked("a.csv:7:x: `3.25` is not a number"), "a.csv:#:x: `…` is not a number");
    }

    #[test]
    fn statistics_hold_no_value() {
        let values: Vec<f64> = (0..50).map(|k| (f64::from(k) * 0.37).sin() * 3.217).collect();
        let recording = recording(values.clone());
        let statistics = statistics(&recording, &recording.warnings);
        assert_eq!(statistics["rows"], 50);
        assert_eq!(statistics["pieces"], json!([50]));
        assert_eq!(statistics["channels"][0]["missing"], 0);
        assert_eq!(statistics["channels"][0]["range"], json!([-3.3, 3.3]));
        let text = statistics.to_string();
        assert_eq!(Values::of([&recording]).taken_out_of(&text), text);
        assert!(values[1..].iter().all(|v| !text.contains(&v.to_string())), "{text}");
    }
}
