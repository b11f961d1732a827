//! Numbers, percentages, units and names as an engineer writes them.
//!
//! Three significant digits, a value with an interval to the digits that its uncertainty carries, a true
//! minus sign, powers of ten as superscripts. All functions return plain text (not HTML-escaped).

use crate::contract::Interval;

/// What stands for a number that is not known.
pub const UNKNOWN: &str = "–";

/// What stands between a sum so far and its next term of this sign: nothing or `−` before the first.
pub(crate) fn joint(first: bool, value: f64) -> &'static str {
    match (first, value < 0.0) {
        (true, true) => "−",
        (true, false) => "",
        (false, true) => " − ",
        (false, false) => " + ",
    }
}

/// A number to three significant digits: `0.115`, `−12.3`, `1.23 × 10⁻⁶`; `–` where not finite.
///
/// ```
/// use greybox_report::format::number;
/// assert_eq!(number(0.11537), "0.115");
/// assert_eq!(number(-1.2345e-6), "−1.23 × 10⁻⁶");
/// assert_eq!(number(f64::NAN), "–");
/// ```
pub fn number(value: f64) -> String {
    significant(value, 3)
}

/// As [`number`], without trailing zeros: `0.2`. For bounds in running text, where digits claim nothing.
pub fn plain(value: f64) -> String {
    let text = number(value);
    match text.split_once(" × ") {
        Some((mantissa, power)) => format!("{} × {power}", trim_zeros(mantissa)),
        None => trim_zeros(&text).to_owned(),
    }
}

fn trim_zeros(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

/// A number to `digits` significant digits.
pub fn significant(value: f64, digits: usize) -> String {
    if !value.is_finite() {
        return UNKNOWN.to_owned();
    }
    let digits = digits.max(1);
    if value == 0.0 {
        return "0".to_owned();
    }
    let exponent = rounded_exponent(value, digits);
    if (-4..6).contains(&exponent) {
        let decimals = (digits as i32 - 1 - exponent).max(0) as usize;
        minus(&format!("{value:.decimals$}"))
    } else {
        let mantissa = value / 10f64.powi(exponent);
        format!("{} × 10{}", minus(&format!("{mantissa:.*}", digits - 1)), superscript(exponent))
    }
}

/// A value with its 95 % interval: `0.115 ± 0.004` where the interval is symmetric about the value, else
/// `0.115 (0.101 … 0.160)`, and the value alone where there is no interval. `0.115 (not determined)` where an end of the
/// interval is not finite: the recordings say nothing of it.
///
/// The half width keeps one significant digit, two where the first is 1 or 2; the value ends at the same
/// decimal place (at most six significant digits).
pub fn with_interval(value: f64, ci95: Option<Interval>) -> String {
    let Some(ci) = ci95 else { return number(value) };
    if !(ci.low.is_finite() && ci.high.is_finite()) {
        return format!("{} (not determined)", number(value));
    }
    let half = ci.half_width();
    if !value.is_finite() || half <= 0.0 {
        return number(value);
    }
    let skew = (0.5 * (ci.low + ci.high) - value).abs() / half;
    if skew > 0.1 {
        return format!("{} ({} … {})", number(value), number(ci.low), number(ci.high));
    }
    let lead = rounded_exponent(half, 1);
    let digits = if half / 10f64.powi(lead) < 2.95 { 2 } else { 1 };
    let place = rounded_exponent(half, digits) - (digits as i32 - 1);
    let size = rounded_exponent(value.abs().max(half), 3);
    if size - place >= 6 {
        return format!("{} ± {}", significant(value, 6), significant(half, digits));
    }
    if (-4..6).contains(&size) {
        let decimals = (-place).max(0) as usize;
        minus(&format!("{value:.decimals$} ± {half:.decimals$}"))
    } else {
        let scale = 10f64.powi(size);
        let decimals = (size - place).max(0) as usize;
        let inner = minus(&format!("{:.decimals$} ± {:.decimals$}", value / scale, half / scale));
        format!("({inner}) × 10{}", superscript(size))
    }
}

/// [`with_interval`] for a narrow column: a line may break before the `±`, not after it.
pub fn cell(value: f64, ci95: Option<Interval>) -> String {
    with_interval(value, ci95).replace("± ", "±\u{a0}")
}

/// An interval `0.101 … 0.160`; `–` where there is none. The ends have three significant digits, and more where
/// the width would not show.
///
/// ```
/// use greybox_report::{contract::Interval, format::interval};
/// assert_eq!(interval(Some(Interval::new(0.1012, 0.1601))), "0.101 … 0.160");
/// assert_eq!(interval(Some(Interval::new(1.99451, 1.99989))), "1.9945 … 1.9999");
/// ```
pub fn interval(ci95: Option<Interval>) -> String {
    match ci95 {
        Some(ci) if ci.low.is_finite() && ci.high.is_finite() => {
            let size = ci.low.abs().max(ci.high.abs());
            let decades = size.log10().floor() - (ci.high - ci.low).abs().log10().floor();
            let digits = if decades.is_finite() { (decades as i32 + 2).clamp(3, 8) as usize } else { 3 };
            format!("{} … {}", significant(ci.low, digits), significant(ci.high, digits))
        }
        _ => UNKNOWN.to_owned(),
    }
}

/// A ratio as a percentage to three significant digits: `28.3 %`, `1.21 %`; `–` where not finite.
pub fn percent(ratio: f64) -> String {
    if !ratio.is_finite() {
        return UNKNOWN.to_owned();
    }
    let value = 100.0 * ratio;
    if value != 0.0 && value.abs() < 0.001 {
        return "< 0.001 %".to_owned();
    }
    format!("{} %", number(value))
}

/// A ratio as a percentage to two significant digits, for running text: `28 %`, `1.2 %`.
pub fn percent_short(ratio: f64) -> String {
    if !ratio.is_finite() {
        return UNKNOWN.to_owned();
    }
    let value = 100.0 * ratio;
    if value != 0.0 && value.abs() < 0.001 {
        return "< 0.001 %".to_owned();
    }
    let digits = if rounded_exponent(value, 2) >= 2 { 3 } else { 2 };
    format!("{} %", significant(value, digits))
}

/// A probability or share as whole percent, never claiming certainty: `81 %`, `> 99 %`, `< 1 %`.
pub fn probability(p: f64) -> String {
    if !p.is_finite() {
        UNKNOWN.to_owned()
    } else if p > 0.995 {
        "> 99 %".to_owned()
    } else if p < 0.005 {
        "< 1 %".to_owned()
    } else {
        format!("{:.0} %", 100.0 * p)
    }
}

/// A unit with raised exponents and middle dots: `kg m^2` → `kg m²`, `N*m/A` → `N·m/A`; nothing for a pure number, `1`.
pub fn unit(text: &str) -> String {
    if text.trim() == "1" {
        return String::new();
    }
    let mut out = String::with_capacity(text.len());
    let mut chars = text.trim().chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '^' => {
                let mut raised = false;
                while let Some(&next) = chars.peek() {
                    let Some(sup) = superscript_char(next) else { break };
                    out.push(sup);
                    raised = true;
                    chars.next();
                }
                if !raised {
                    out.push('^');
                }
            }
            '*' => out.push('·'),
            other => out.push(other),
        }
    }
    out
}

/// Joins by no-break spaces what must stay on one line: a value and its `±`, a number and its `%` or unit
/// symbol after it. For running text on the page; the text in `report.json` keeps plain spaces.
pub fn tie(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find(' ') {
        let (before, after) = (&rest[..at], &rest[at + 1..]);
        let signs = ['±', '%', '×', '=', '<', '>'];
        let tight = after.starts_with(signs) || before.ends_with(['±', '×', '=', '<', '>']);
        // A number and the unit that follows it, not the word that does.
        let word = after.split([' ', ';', ',', '.']).next().unwrap_or("");
        let measured = before.ends_with(|c: char| c.is_ascii_digit()) && word.chars().count() <= 2;
        out.push_str(before);
        out.push(if tight || (measured && !matches!(word, "to" | "in" | "of" | "or")) {
            '\u{a0}'
        } else {
            ' '
        });
        rest = after;
    }
    out.push_str(rest);
    out
}

/// A value followed by its unit, the value alone for an empty unit.
pub fn with_unit(value: &str, unit_text: &str) -> String {
    let unit_text = unit(unit_text);
    if unit_text.is_empty() || unit_text == "1" {
        return value.to_owned();
    }
    if value.contains('±') && !value.contains("× 10") {
        return format!("({value}) {unit_text}");
    }
    format!("{value} {unit_text}")
}

/// A snake_case kind as words: `coulomb_friction` → `Coulomb friction`, `dead_zone` → `Dead zone`.
pub fn kind(name: &str) -> String {
    capital(&kind_in_sentence(name))
}

/// The text with a capital at its beginning.
pub(crate) fn capital(text: &str) -> String {
    let mut chars = text.chars();
    match chars.next() {
        Some(first) => first.to_uppercase().chain(chars).collect(),
        None => String::new(),
    }
}

/// As [`kind`], for the middle of a sentence: only proper names are capitalised.
pub fn kind_in_sentence(name: &str) -> String {
    let words = name.split('_').map(|word| match word {
        "coulomb" => "Coulomb",
        "maxwell" => "Maxwell",
        "stribeck" => "Stribeck",
        "unmodeled" => "unmodelled",
        other => other,
    });
    words.collect::<Vec<_>>().join(" ").replace("bouc wen", "Bouc–Wen")
}

/// Exponent of ten of `value` after rounding to `digits` significant digits (9.996 → 1 for three digits).
fn rounded_exponent(value: f64, digits: usize) -> i32 {
    if value == 0.0 || !value.is_finite() {
        return 0;
    }
    let scientific = format!("{:.*e}", digits.saturating_sub(1), value);
    scientific.split_once('e').and_then(|(_, e)| e.parse().ok()).unwrap_or(0)
}

/// The exponent of a power of ten as superscript.
fn superscript(exponent: i32) -> String {
    exponent.to_string().chars().filter_map(superscript_char).collect()
}

pub(crate) fn superscript_char(c: char) -> Option<char> {
    Some(match c {
        '-' => '⁻',
        '+' => '⁺',
        '.' => '·',
        '0' => '⁰',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        '4' => '⁴',
        '5' => '⁵',
        '6' => '⁶',
        '7' => '⁷',
        '8' => '⁸',
        '9' => '⁹',
        _ => return None,
    })
}

/// Typographic minus; a rounded negative zero loses its sign.
fn minus(text: &str) -> String {
    let zero = text.strip_prefix('-').filter(|rest| rest.chars().all(|c| matches!(c, '0' | '.')));
    zero.unwrap_or(text).replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_significant_digits() {
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "0"),
            (1.0, "1.00"),
            (0.0024, "0.00240"),
            (9.996, "10.0"),
            (123_456.0, "123456"),
            (1_234_567.0, "1.23 × 10⁶"),
            (-0.000_012_34, "−1.23 × 10⁻⁵"),
            (f64::INFINITY, "–"),
            (f64::MIN_POSITIVE, "2.23 × 10⁻³⁰⁸"),
        ] {
            assert_eq!(number(value), text, "{value:e}");
        }
    }

    #[test]
    fn intervals_decide_the_digits() {
        let ci = |low, high| Some(Interval::new(low, high));
        assert_eq!(with_interval(0.1152, ci(0.1112, 0.1192)), "0.115 ± 0.004");
        assert_eq!(with_interval(0.1152, ci(0.1037, 0.1267)), "0.115 ± 0.012");
        assert_eq!(with_interval(0.1152, ci(0.1130, 0.15)), "0.115 (0.113 … 0.150)");
        assert_eq!(with_interval(2.0e-6, ci(1.9e-6, 2.1e-6)), "(2.00 ± 0.10) × 10⁻⁶");
        assert_eq!(with_interval(-0.5, ci(-0.9, -0.1)), "−0.5 ± 0.4");
        assert_eq!(with_interval(2.0, ci(2.0 - 3e-9, 2.0 + 3e-9)), "2.00000 ± 3 × 10⁻⁹");
        assert_eq!(with_interval(2.0, ci(2.0, 2.0)), "2.00");
        assert_eq!(with_interval(2.0, ci(f64::NAN, 2.1)), "2.00 (not determined)");
        assert_eq!(with_interval(2.0, None), "2.00");
        assert_eq!(with_interval(f64::NAN, ci(1.0, 2.0)), "–");
        assert_eq!(with_interval(2.0, None), "2.00");
        assert_eq!(with_interval(1234.0, ci(1234.0 - 56.0, 1234.0 + 56.0)), "1234 ± 56");
    }

    #[test]
    fn percentages_and_probabilities() {
        assert_eq!(percent(0.2834), "28.3 %");
        assert_eq!(plain(0.2), "0.2");
        assert_eq!(plain(100.0), "100");
        assert_eq!(plain(2e-7), "2 × 10⁻⁷");
        assert_eq!(percent(1.3), "130 %");
        assert_eq!(percent(1e-9), "< 0.001 %");
        assert_eq!(percent(f64::NAN), "–");
        assert_eq!(percent_short(0.2834), "28 %");
        assert_eq!(percent_short(0.0121), "1.2 %");
        assert_eq!(percent_short(1.342), "134 %");
        assert_eq!(probability(0.9999), "> 99 %");
        assert_eq!(probability(0.81), "81 %");
        assert_eq!(probability(1e-6), "< 1 %");
    }

    #[test]
    fn units_and_kinds() {
        assert_eq!(unit("kg m^2"), "kg m²");
        assert_eq!(unit("N*m*s^-1"), "N·m·s⁻¹");
        assert_eq!(unit("x^y"), "x^y");
        assert_eq!(with_unit("0.115 ± 0.004", "N m"), "(0.115 ± 0.004) N m");
        assert_eq!(with_unit("2", ""), "2");
        assert_eq!(
            tie("fc = 0.1 ± 0.2 N m; from 28 % to 3"),
            "fc\u{a0}=\u{a0}0.1\u{a0}±\u{a0}0.2\u{a0}N m; from 28\u{a0}% to 3"
        );
        assert_eq!(kind("coulomb_friction"), "Coulomb friction");
        assert_eq!(kind("bouc_wen_hysteresis"), "Bouc–Wen hysteresis");
        assert_eq!(kind("dead_zone"), "Dead zone");
        assert_eq!(kind_in_sentence("dead_zone"), "dead zone");
        assert_eq!(kind(""), "");
    }
}
