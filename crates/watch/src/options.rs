//! What is asked of a watch.

use crate::error::WatchError;

/// Blocks into which the learned seconds are cut at first: as many as leave eight samples in each, within these bounds.
pub(crate) const BLOCKS: (usize, usize) = (25, 200);
/// Samples of such a block.
pub(crate) const BLOCK_SAMPLES: usize = 8;

/// What is asked of a watch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Seconds at the beginning in which it is learned what is usual.
    pub learn: f64,
    /// Seconds that the estimates remember.
    pub memory: f64,
    /// False alarms a day, of all that is watched together.
    pub alarms_per_day: f64,
}

impl Default for Options {
    fn default() -> Options {
        Options { learn: 60.0, memory: 30.0, alarms_per_day: 1.0 }
    }
}

impl Options {
    /// Sees that the options make sense.
    ///
    /// # Errors
    /// [`WatchError::Option`].
    pub fn check(&self) -> Result<(), WatchError> {
        let positive = "write a positive number of seconds";
        let options = [
            ("the time to learn", self.learn, positive),
            ("the memory", self.memory, positive),
            ("the number of false alarms a day", self.alarms_per_day, "write a positive number"),
        ];
        match options.into_iter().find(|(_, value, _)| !(value.is_finite() && *value > 0.0)) {
            Some((option, value, help)) => Err(WatchError::Option { option, value, help }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_positive_numbers_make_sense() {
        assert!(Options::default().check().is_ok());
        for wrong in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(Options { learn: wrong, ..Options::default() }.check().is_err());
            assert!(Options { memory: wrong, ..Options::default() }.check().is_err());
            assert!(Options { alarms_per_day: wrong, ..Options::default() }.check().is_err());
        }
    }
}
