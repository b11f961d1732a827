//! The times of samples as they are written: dates, and numbers too large for a double.

use chrono::{DateTime, FixedOffset, NaiveDateTime, SecondsFormat, TimeDelta};

/// Seconds up to which a double has room for nanoseconds.
pub const ROOM: i64 = 1 << 23;

/// What a time counts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Zone {
    /// A number of seconds: from an instant that nobody states.
    Seconds,
    /// A date without an offset: from 1970-01-01T00:00:00 on the clock that wrote it.
    Unstated,
    /// A date: from 1970-01-01T00:00:00Z; it was written with this offset from UTC, in seconds.
    Offset(i32),
}

/// A time: whole seconds and the rest, which together have more digits than a double.
///
/// ```
/// use greybox_recording::{Stamp, Zone};
/// let stamp = Stamp::date("2026-11-29T13:34:56.789+01:00").expect("a date");
/// assert_eq!((stamp.seconds, stamp.rest, stamp.zone), (1_795_955_696, 0.789, Zone::Offset(3600)));
/// assert_eq!(stamp.zone.date(stamp.seconds, 0.789).as_deref(), Some("2026-11-29T13:34:56.789+01:00"));
/// assert_eq!(Stamp::date("12.5"), None);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stamp {
    /// Whole seconds.
    pub seconds: i64,
    /// The rest, s.
    pub rest: f64,
    /// What they count from.
    pub zone: Zone,
}

impl Stamp {
    /// A number of seconds.
    pub fn number(seconds: f64) -> Stamp {
        // (A number beyond all integers is the last of them.)
        Stamp { seconds: seconds as i64, rest: seconds.fract(), zone: Zone::Seconds }
    }

    /// A count of the unit of which `per_second` make a second.
    pub fn count(count: i128, per_second: u32, zone: Zone) -> Stamp {
        let per = i128::from(per_second.max(1));
        let seconds =
            i64::try_from(count.div_euclid(per)).unwrap_or(if count < 0 { i64::MIN } else { i64::MAX });
        Stamp { seconds, rest: count.rem_euclid(per) as f64 / f64::from(per_second.max(1)), zone }
    }

    /// A date as RFC 3339 and ISO 8601 have it: `2026-11-29T12:34:56.789Z`, with `+01:00`, `+0100` or no offset at all, a
    /// space or a `T` before the time, a point or a comma before its fractions. `None` for anything else.
    pub fn date(text: &str) -> Option<Stamp> {
        let text = text.trim();
        // (What is no date is told by its first characters.)
        if text.as_bytes().get(4) != Some(&b'-') {
            return None;
        }
        let text = text.replacen(',', ".", 1).replacen(' ', "T", 1);
        let dated = DateTime::parse_from_rfc3339(&text)
            .or_else(|_| DateTime::parse_from_str(&text, "%Y-%m-%dT%H:%M:%S%.f%#z"));
        let (since, zone) = match dated {
            Ok(date) => (date.to_utc(), Zone::Offset(date.offset().local_minus_utc())),
            Err(_) => {
                let date = NaiveDateTime::parse_from_str(&text, "%Y-%m-%dT%H:%M:%S%.f");
                (date.ok()?.and_utc(), Zone::Unstated)
            }
        };
        // (A leap second has more nanoseconds than others, and is the first of the next minute.)
        let nanoseconds = since.timestamp_subsec_nanos();
        let seconds = since.timestamp() + i64::from(nanoseconds / 1_000_000_000);
        Some(Stamp { seconds, rest: f64::from(nanoseconds % 1_000_000_000) / 1e9, zone })
    }

    /// A decimal number of a unit, whose power of ten is `exponent` (−3: milliseconds): every digit of one that a double has
    /// no room for. `None` for anything but a finite number.
    pub fn decimal(text: &str, exponent: i32) -> Option<Stamp> {
        let value: f64 = text.parse().ok().filter(|v: &f64| v.is_finite())?;
        let seconds = value * scale(exponent);
        let exact = if seconds.abs() > ROOM as f64 { exact(text, exponent) } else { None };
        Some(exact.unwrap_or_else(|| Stamp::number(seconds)))
    }

    /// The same of a part of a time: it may be small and belong to a large one, so that every digit counts.
    pub(crate) fn part(text: &str, exponent: i32) -> Option<Stamp> {
        exact(text, exponent).or_else(|| Stamp::decimal(text, exponent))
    }

    /// This time and another part of it.
    pub(crate) fn plus(self, part: Stamp) -> Stamp {
        let rest = self.rest + part.rest;
        let whole = rest.floor();
        let seconds = self.seconds.saturating_add(part.seconds).saturating_add(whole as i64);
        Stamp { seconds, rest: rest - whole, zone: self.zone }
    }

    /// Seconds after `origin`, which is in whole ones.
    pub fn after(&self, origin: i64) -> f64 {
        self.seconds.saturating_sub(origin) as f64 + self.rest
    }
}

/// Every digit of a decimal number without an exponent; `None` where there are too many.
fn exact(text: &str, exponent: i32) -> Option<Stamp> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits: i128 = format!("{whole}{fraction}").parse().ok()?;
    let per = 10u32.checked_pow(u32::try_from(fraction.len()).ok()?.checked_add_signed(-exponent)?)?;
    Some(Stamp::count(digits, per, Zone::Seconds))
}

/// Seconds per unit.
pub(crate) fn scale(exponent: i32) -> f64 {
    match exponent {
        0 => 1.0,
        -3 => 1e-3,
        -6 => 1e-6,
        -9 => 1e-9,
        other => 10f64.powi(other),
    }
}

impl Zone {
    /// Whether times of both are on one clock. Offsets from UTC may change, with the season for example.
    pub fn is_as(self, other: Zone) -> bool {
        self == other || matches!((self, other), (Zone::Offset(_), Zone::Offset(_)))
    }

    /// The date, to the microsecond, `rest` seconds after `origin`; `None` for a number of seconds, and outside the calendar.
    pub fn date(self, origin: i64, rest: f64) -> Option<String> {
        self.written(origin, rest, 1e6, SecondsFormat::AutoSi)
    }

    /// The same to the millisecond.
    pub fn date_millis(self, origin: i64, rest: f64) -> Option<String> {
        self.written(origin, rest, 1e3, SecondsFormat::Millis)
    }

    fn written(self, origin: i64, rest: f64, digits: f64, format: SecondsFormat) -> Option<String> {
        let offset = match self {
            Zone::Seconds => return None,
            Zone::Unstated => FixedOffset::east_opt(0)?,
            Zone::Offset(seconds) => FixedOffset::east_opt(seconds)?,
        };
        if !rest.is_finite() {
            return None;
        }
        let nanoseconds = (rest.rem_euclid(1.0) * digits).round() * (1e9 / digits);
        let whole = DateTime::from_timestamp(origin.checked_add(rest.floor() as i64)?, 0)?;
        let date = whole.checked_add_signed(TimeDelta::nanoseconds(nanoseconds as i64))?;
        let text = date.with_timezone(&offset).to_rfc3339_opts(format, true);
        Some(match self {
            Zone::Unstated => text.trim_end_matches('Z').to_owned(),
            _ => text,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_read_in_the_forms_that_loggers_write() {
        let noon = 1_795_955_696;
        for (text, rest, zone) in [
            ("2026-11-29T12:34:56Z", 0.0, Zone::Offset(0)),
            ("2026-11-29t12:34:56z", 0.0, Zone::Offset(0)),
            ("2026-11-29 12:34:56+00:00", 0.0, Zone::Offset(0)),
            ("2026-11-29T14:34:56.25+02:00", 0.25, Zone::Offset(7200)),
            ("2026-11-29T14:34:56.25+0200", 0.25, Zone::Offset(7200)),
            ("2026-11-29T14:34:56.25+02", 0.25, Zone::Offset(7200)),
            ("2026-11-29 12:34:56,789", 0.789, Zone::Unstated),
            ("2026-11-29T12:34:56.123456789", 0.123_456_789, Zone::Unstated),
            // A leap second is the one after it.
            ("2026-11-29T12:34:55.5Z", -0.5, Zone::Offset(0)),
        ] {
            let stamp = Stamp::date(text).unwrap_or_else(|| panic!("{text}"));
            assert_eq!((stamp.after(noon), stamp.zone), (rest, zone), "{text}");
        }
        let leap = Stamp::date("2016-12-31T23:59:60.5Z").unwrap();
        assert_eq!(leap, Stamp::date("2017-01-01T00:00:00.5Z").unwrap());
        for text in
            ["", "12.5", "2026", "2026-11-29", "2026-13-01T00:00:00Z", "29.11.2026 12:34", "abcd-ä", "äöü-"]
        {
            assert_eq!(Stamp::date(text), None, "{text}");
        }
    }

    #[test]
    fn dates_are_written_as_they_were_read() {
        let zone = Zone::Offset(-5400);
        assert_eq!(zone.date_millis(0, -0.0006).as_deref(), Some("1969-12-31T22:29:59.999-01:30"));
        assert_eq!(zone.date_millis(0, 0.9996).as_deref(), Some("1969-12-31T22:30:01.000-01:30"));
        assert_eq!(zone.date(1_795_955_696, 0.1234565).as_deref(), Some("2026-11-29T11:04:56.123457-01:30"));
        assert_eq!(Zone::Unstated.date(1_795_955_696, 60.0).as_deref(), Some("2026-11-29T12:35:56"));
        assert_eq!(Zone::Seconds.date(0, 0.0), None);
        assert_eq!(Zone::Offset(0).date(i64::MAX, 1.0), None);
        assert_eq!(Zone::Offset(0).date(0, f64::NAN), None);
        assert_eq!(Zone::Offset(0).date(0, 1e300), None);
    }

    #[test]
    fn large_numbers_keep_their_digits() {
        let origin = 1_795_955_696;
        for (text, exponent) in [
            ("1795955696789123456", -9),
            ("1795955696789123.456", -6),
            ("1795955696789.123456", -3),
            ("1795955696.789123456", 0),
        ] {
            let stamp = Stamp::decimal(text, exponent).unwrap();
            assert_eq!(stamp.after(origin), 0.789_123_456, "{text}");
        }
        // Of others nothing changes.
        for text in ["12.34", "0.1", "-7.7", "1e-3", "8388607.9"] {
            let value: f64 = text.parse().unwrap();
            assert_eq!(Stamp::decimal(text, 0).unwrap().after(0).to_bits(), value.to_bits(), "{text}");
            assert_eq!(
                Stamp::decimal(text, -3).unwrap().after(0).to_bits(),
                (value * 1e-3).to_bits(),
                "{text}"
            );
        }
        for text in ["", "x", "inf", "nan"] {
            assert_eq!(Stamp::decimal(text, 0), None, "{text}");
        }
        // No panic on what no clock shows.
        for text in ["1e300", "-1e300", "99999999999999999999999999999999999999999", "9e18", "1e18.5"] {
            if let Some(stamp) = Stamp::decimal(text, -9) {
                let _ = (stamp.after(i64::MIN), stamp.after(i64::MAX));
            }
        }
        assert_eq!(Stamp::count(i128::MIN, 1, Zone::Seconds).seconds, i64::MIN);
        assert_eq!(Stamp::count(-1, 4, Zone::Offset(0)).after(0), -0.25);
    }
}
