//! Channels under the names that a model uses.

use crate::error::Place;
use crate::finding::listed;
use crate::header::{header_cell, list_element};
use crate::recording::Recording;
use std::fmt;
use std::str::FromStr;

/// A channel of a file and what it is to be called.
///
/// Its text is `NAME=CHANNEL`, or `NAME=CHANNEL [unit]` where the file states no unit. A number in brackets right behind the
/// channel, as in `state[0]`, is part of its name: an element of lists.
///
/// ```
/// let rename: greybox_recording::Rename = "theta=sensor_3 [deg]".parse()?;
/// assert_eq!((rename.name.as_str(), rename.channel.as_str()), ("theta", "sensor_3"));
/// assert_eq!(rename.unit.as_deref(), Some("deg"));
/// # Ok::<(), greybox_recording::RenameError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rename {
    /// The name it gets.
    pub name: String,
    /// The name it has in the file.
    pub channel: String,
    /// The unit it has; `None` = as in the file.
    pub unit: Option<String>,
}

/// Why channels were not renamed. Each message is one sentence with the fix.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RenameError {
    /// The text is no [`Rename`].
    #[error("`{found}` is not `NAME=CHANNEL` or `NAME=CHANNEL [unit]`: write it like `theta=sensor_3 [deg]`")]
    Syntax {
        /// The text.
        found: String,
    },
    /// The file has no such channel.
    #[error("{file}: there is no channel `{channel}`; the file has {}", listed(available.iter().map(|a| format!("`{a}`")).collect()))]
    Unknown {
        /// The recording.
        file: String,
        /// The channel that was looked for.
        channel: String,
        /// The channels of the file.
        available: Vec<String>,
    },
    /// Another channel of the file has the name already.
    #[error(
        "{file}: the file has a channel `{name}` already: give that one another name too, `other={name}`"
    )]
    Taken {
        /// The recording.
        file: String,
        /// The name.
        name: String,
    },
    /// Two renames have one name or one channel.
    #[error("`{name}` stands in two renames on the same side of `=`: leave one of them out")]
    Twice {
        /// The name or channel.
        name: String,
    },
    /// The file states another unit.
    #[error(
        "{file}: the file states channel `{channel}` in [{stated}], not [{found}]: leave the unit out, or correct the file"
    )]
    Unit {
        /// The recording.
        file: String,
        /// The channel.
        channel: String,
        /// Unit of the rename.
        found: String,
        /// Unit of the file.
        stated: String,
    },
}

impl FromStr for Rename {
    type Err = RenameError;

    fn from_str(text: &str) -> Result<Self, RenameError> {
        let wrong = || RenameError::Syntax { found: text.to_owned() };
        let (name, channel) = text.split_once('=').ok_or_else(wrong)?;
        let (channel, unit) = match list_element(channel.trim()) {
            Some(element) => element,
            None => header_cell(channel.trim(), || Place::file("")).map_err(|_| wrong())?,
        };
        let name = name.trim();
        if name.is_empty() || name.contains(['[', ']']) {
            return Err(wrong());
        }
        Ok(Rename { name: name.to_owned(), channel, unit })
    }
}

/// As [`FromStr`] reads it.
impl fmt::Display for Rename {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.name, self.channel)?;
        self.unit.as_ref().map_or(Ok(()), |unit| write!(f, " [{unit}]"))
    }
}

impl Recording {
    /// Renames channels, all at once (so that two may change places), and gives units to those that have none.
    ///
    /// # Errors
    /// [`RenameError`]; then the recording is as it was.
    pub fn rename(&mut self, renames: &[Rename]) -> Result<(), RenameError> {
        let mut channels: Vec<_> = self.channels.iter().map(|c| (c.name.clone(), c.unit.clone())).collect();
        for (k, rename) in renames.iter().enumerate() {
            let twice = |name: &String| RenameError::Twice { name: name.clone() };
            if renames[..k].iter().any(|other| other.name == rename.name) {
                return Err(twice(&rename.name));
            }
            if renames[..k].iter().any(|other| other.channel == rename.channel) {
                return Err(twice(&rename.channel));
            }
            let (file, channel) = (self.name.clone(), rename.channel.clone());
            let Some(index) = self.channel_index(&channel) else {
                let available = self.channels.iter().map(|c| c.name.clone()).collect();
                return Err(RenameError::Unknown { file, channel, available });
            };
            let unit = match (&rename.unit, &channels[index].1) {
                (Some(found), Some(stated)) if found != stated => {
                    return Err(RenameError::Unit {
                        file,
                        channel,
                        found: found.clone(),
                        stated: stated.clone(),
                    });
                }
                (unit, stated) => unit.clone().or_else(|| stated.clone()),
            };
            channels[index] = (rename.name.clone(), unit);
        }
        for rename in renames {
            if channels.iter().filter(|(name, _)| *name == rename.name).count() > 1 {
                return Err(RenameError::Taken { file: self.name.clone(), name: rename.name.clone() });
            }
        }
        for (channel, (name, unit)) in self.channels.iter_mut().zip(channels) {
            (channel.name, channel.unit) = (name, unit);
        }
        for warning in &mut self.warnings {
            let renamed = renames.iter().find(|r| warning.channel.as_ref() == Some(&r.channel));
            warning.channel = renamed.map(|r| r.name.clone()).or(warning.channel.take());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::Channel;

    fn recording() -> Recording {
        let time: Vec<f64> = (0..20).map(f64::from).collect();
        let channel = |name: &str, unit: Option<&str>, factor: f64| Channel {
            name: name.into(),
            unit: unit.map(Into::into),
            values: time.iter().map(|t| factor * t).collect(),
        };
        let channels = vec![channel("a", None, 1.0), channel("b", Some("m"), 2.0), channel("c", None, 3.0)];
        Recording::from_columns("r", time.clone(), channels).unwrap()
    }

    fn renamed(texts: &[&str]) -> Result<Vec<String>, RenameError> {
        let renames = texts.iter().map(|t| t.parse()).collect::<Result<Vec<_>, _>>()?;
        let mut recording = recording();
        recording.rename(&renames).map(|()| recording.channels.iter().map(Channel::header).collect())
    }

    #[test]
    fn channels_get_names_and_units() {
        assert_eq!(renamed(&["theta=a [deg]", "x = b"]).unwrap(), ["theta [deg]", "x [m]", "c"]);
        assert_eq!(renamed(&["a=b", "b=a"]).unwrap(), ["b", "a [m]", "c"], "they change places");
        assert_eq!(renamed(&["b=b [m]"]).unwrap(), ["a", "b [m]", "c"]);
    }

    #[test]
    fn elements_of_lists_have_names() {
        for (text, channel, unit) in [
            ("q=state[0]", "state[0]", None),
            ("q=state[12] [deg]", "state[12]", Some("deg")),
            ("q=state [1]", "state", Some("1")),
            ("q=state[m]", "state", Some("m")),
        ] {
            let rename: Rename = text.parse().unwrap();
            assert_eq!((rename.channel.as_str(), rename.unit.as_deref()), (channel, unit), "{text}");
            assert_eq!(rename.to_string().parse::<Rename>().unwrap(), rename);
        }
        for wrong in ["q=[0]", "q=state[0][1]", "q=state[0] [deg", "q=state[]]"] {
            assert!(wrong.parse::<Rename>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_cannot_be_renamed_is_told() {
        for (texts, part) in [
            (&["theta"] as &[&str], "`theta` is not `NAME=CHANNEL`"),
            (&["=a"], "is not `NAME=CHANNEL`"),
            (&["theta="], "is not `NAME=CHANNEL`"),
            (&["theta=a [deg"], "is not `NAME=CHANNEL`"),
            (&["theta=d"], "no channel `d`; the file has `a`, `b`, `c`"),
            (&["b=a"], "a channel `b` already"),
            (&["x=a", "x=c"], "`x` stands in two renames"),
            (&["x=a", "y=a"], "`a` stands in two renames"),
            (&["x=b [mm]"], "channel `b` in [m], not [mm]"),
        ] {
            let error = renamed(texts).unwrap_err().to_string();
            assert!(error.contains(part), "{texts:?}: {error}");
        }
    }
}
