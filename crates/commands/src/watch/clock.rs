//! The clock of the samples: what a watch counts in seconds, as the samples have it.

use greybox_recording::{ROOM, Stamp, Zone};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// What the times of a watch count from, and how they are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Clock {
    /// Whole seconds that are taken from every time: what is left has room for nanoseconds.
    origin: i64,
    zone: Zone,
}

/// A clock of seconds from nought.
impl Default for Clock {
    fn default() -> Clock {
        Clock { origin: 0, zone: Zone::Seconds }
    }
}

impl Clock {
    /// The clock of the samples of which this is the first time.
    pub(super) fn of(first: &Stamp) -> Clock {
        let small = first.zone == Zone::Seconds && first.seconds.saturating_abs() < ROOM;
        Clock { origin: if small { 0 } else { first.seconds }, zone: first.zone }
    }

    /// The seconds of a time on this clock; of dates, the last one says in which offset from UTC they are written.
    ///
    /// # Errors
    /// A time of another kind.
    pub(super) fn read(&mut self, stamp: &Stamp) -> Result<f64, String> {
        if !self.zone.is_as(stamp.zone) {
            let (found, before) = (kind(stamp.zone), kind(self.zone));
            return Err(format!("the time is {found}; those before are {before}"));
        }
        self.zone = stamp.zone;
        Ok(stamp.after(self.origin))
    }

    /// A time of an event, for machines: a number of seconds, or a date.
    pub(super) fn value(self, t: f64) -> Value {
        self.zone.date(self.origin, t).map_or_else(|| (self.origin as f64 + t).into(), Value::from)
    }

    /// The same in words, to the millisecond.
    pub(super) fn words(self, t: f64) -> String {
        let date = self.zone.date_millis(self.origin, t);
        date.unwrap_or_else(|| format!("{:.3} s", self.origin as f64 + t))
    }
}

fn kind(zone: Zone) -> &'static str {
    match zone {
        Zone::Seconds => "a number of seconds",
        Zone::Unstated => "a date without an offset from UTC",
        Zone::Offset(_) => "a date with an offset from UTC",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_come_back_as_they_were_read() {
        let date = |text| Stamp::date(text).unwrap();
        let mut clock = Clock::of(&date("2026-11-29T13:34:56.789+01:00"));
        let t = clock.read(&date("2026-11-29T12:34:57.5Z")).unwrap();
        assert_eq!(t, 1.5);
        assert_eq!(clock.value(t), "2026-11-29T12:34:57.500Z");
        assert_eq!(clock.words(t), "2026-11-29T12:34:57.500Z");
        for other in [Stamp::number(1.0), date("2026-11-29T12:34:57")] {
            assert!(
                clock.read(&other).unwrap_err().ends_with("those before are a date with an offset from UTC")
            );
        }
        let small = Clock::of(&Stamp::number(12.5));
        assert_eq!(
            (small, small.value(3.0), small.words(3.0).as_str()),
            (Clock::default(), 3.0.into(), "3.000 s")
        );
        let mut large = Clock::of(&Stamp::decimal("1795955696.1", 0).unwrap());
        let t = large.read(&Stamp::decimal("1795955696.123456789", 0).unwrap()).unwrap();
        assert_eq!((t, large.value(t)), (0.123_456_789, 1_795_955_696.123_456_8.into()));
    }
}
