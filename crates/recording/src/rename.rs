//! Channels under the names that a model uses.

use crate::finding::listed;
use crate::header::parts;
use crate::recording::Recording;
use std::fmt;
use std::str::FromStr;

/// A channel of a file and what it is to be called.
///
/// Its text is `NAME=CHANNEL`, or `NAME=CHANNEL [unit]` where the file states no unit. A bracket may also belong to the
/// name: of a file with a channel `position[elbow]`, `theta=position[elbow]` means that one.
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
    /// Name and unit as written: the name it has in a file with a channel called so, which then gets no unit.
    pub written: String,
}

impl Rename {
    /// Name and unit of its channel in a file with channels of which `has` tells.
    pub fn meant(&self, has: impl Fn(&str) -> bool) -> (&str, Option<&str>) {
        match has(&self.written) {
            true => (&self.written, None),
            false => (&self.channel, self.unit.as_deref()),
        }
    }

    /// The names that its channel may have in a file, the likelier one first.
    pub fn names(&self) -> Vec<String> {
        let mut names = vec![self.written.clone(), self.channel.clone()];
        names.dedup();
        names
    }

    /// Whether its bracket can be nothing but a unit: it stands apart from the name.
    pub fn states_unit(&self) -> bool {
        let head = self.written.rfind('[').map(|at| &self.written[..at]);
        self.unit.is_some() && head.is_some_and(|head| head.ends_with(char::is_whitespace))
    }
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
        let (name, written) = (name.trim(), channel.trim());
        let (channel, unit) = parts(written).map_err(|_| wrong())?;
        if name.is_empty() || name.contains(['[', ']']) {
            return Err(wrong());
        }
        let (channel, unit) = (channel.to_owned(), unit.map(str::to_owned));
        Ok(Rename { name: name.to_owned(), channel, unit, written: written.to_owned() })
    }
}

/// As [`FromStr`] reads it.
impl fmt::Display for Rename {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.name, self.written)
    }
}

impl Recording {
    /// Renames channels, all at once (so that two may change places), and gives units to those that have none.
    ///
    /// # Errors
    /// [`RenameError`]; then the recording is as it was.
    pub fn rename(&mut self, renames: &[Rename]) -> Result<(), RenameError> {
        let mut channels: Vec<_> = self.channels.iter().map(|c| (c.name.clone(), c.unit.clone())).collect();
        let meant = |rename: &Rename| {
            let (channel, unit) = rename.meant(|name| self.channel(name).is_some());
            (channel.to_owned(), unit.map(str::to_owned))
        };
        for (k, rename) in renames.iter().enumerate() {
            let twice = |name: &String| RenameError::Twice { name: name.clone() };
            if renames[..k].iter().any(|other| other.name == rename.name) {
                return Err(twice(&rename.name));
            }
            let (channel, unit) = meant(rename);
            if renames[..k].iter().any(|other| meant(other).0 == channel) {
                return Err(twice(&channel));
            }
            let file = self.name.clone();
            let Some(index) = self.channel_index(&channel) else {
                let available = self.channels.iter().map(|c| c.name.clone()).collect();
                let channel = if rename.states_unit() { channel } else { rename.written.clone() };
                return Err(RenameError::Unknown { file, channel, available });
            };
            let unit = match (&unit, &channels[index].1) {
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
        let old: Vec<String> = renames.iter().map(|rename| meant(rename).0).collect();
        for (channel, (name, unit)) in self.channels.iter_mut().zip(channels) {
            (channel.name, channel.unit) = (name, unit);
        }
        for warning in &mut self.warnings {
            let renamed = renames.iter().zip(&old).find(|(_, old)| warning.channel.as_ref() == Some(old));
            warning.channel = renamed.map(|(r, _)| r.name.clone()).or(warning.channel.take());
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
    fn a_bracket_may_belong_to_the_name() {
        let mut recording = recording();
        recording.channels[0].name = "/j.position[elbow]".to_owned();
        recording.channels[2].name = "/j.effort".to_owned();
        let renames =
            ["theta=/j.position[elbow] [deg]", "tau=/j.effort[N]", "x=b"].map(|t| t.parse().unwrap());
        let renamed = |renames: &[Rename]| {
            let mut recording = recording.clone();
            recording
                .rename(renames)
                .map(|()| recording.channels.iter().map(Channel::header).collect::<Vec<_>>())
        };
        assert_eq!(renamed(&renames).unwrap(), ["theta [deg]", "x [m]", "tau [N]"]);
        let whole: Rename = "theta=/j.position[elbow]".parse().unwrap();
        assert_eq!(whole.to_string(), "theta=/j.position[elbow]");
        assert_eq!(renamed(&[whole]).unwrap()[0], "theta");
        let wrong = "theta=/j.position[elbw]".parse().unwrap();
        let error = renamed(&[wrong]).unwrap_err().to_string();
        assert!(
            error.contains("no channel `/j.position[elbw]`; the file has `/j.position[elbow]`"),
            "{error}"
        );
    }

    #[test]
    fn what_cannot_be_renamed_is_told() {
        for (texts, part) in [
            (&["theta"] as &[&str], "`theta` is not `NAME=CHANNEL`"),
            (&["=a"], "is not `NAME=CHANNEL`"),
            (&["theta="], "is not `NAME=CHANNEL`"),
            (&["theta=a [deg"], "is not `NAME=CHANNEL`"),
            (&["theta=a] []"], "is not `NAME=CHANNEL`"),
            (&["theta=[deg]"], "is not `NAME=CHANNEL`"),
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
