//! Which channels of a file are read.

use crate::finding::Finding;
use crate::recording::Recording;
use crate::rename::{Rename, RenameError};

/// Which channels of a file are read.
///
/// ```
/// use greybox_recording::Selection;
/// let everything = Selection::default();
/// let two = Selection { channels: vec!["/cmd.data".into(), "/joint_states.position[elbow]".into()], ..everything };
/// assert_eq!(two.channels.len(), 2);
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Selection {
    /// These alone are read, from any file; none = no such wish.
    pub channels: Vec<String>,
    /// What a model or a renaming names. Only these are read from a file whose signals have several clocks, since the
    /// fastest signal that is read sets the grid for all. Of each list the first one that the file has counts; where a
    /// file lacks one altogether, all of it is read.
    pub named: Vec<Vec<String>>,
}

impl Selection {
    /// These channels alone, and those that the renames name.
    pub fn of(channels: &[String], renames: &[Rename]) -> Selection {
        let named: Vec<Vec<String>> = renames.iter().map(Rename::names).collect();
        Selection { channels: channels.to_vec(), named }
    }

    /// Adds what a model names: lists of names of which one is read, such as those of its inputs and measurements. What a
    /// rename gives a name to is there already.
    #[must_use]
    pub fn with(mut self, renames: &[Rename], names: impl IntoIterator<Item = Vec<String>>) -> Selection {
        let given = |name: &String| renames.iter().any(|rename| rename.name == *name);
        self.named.extend(names.into_iter().filter(|names| !names.iter().any(given)));
        self
    }

    /// Every name in it.
    #[cfg(feature = "mcap")]
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.channels.iter().chain(self.named.iter().flatten()).map(String::as_str)
    }

    /// The channels to be read among the `available` ones of a file with several clocks; `None` = all of them, since nothing
    /// is selected, or something that is not there.
    #[cfg(any(test, feature = "mcap", feature = "mat"))]
    pub(crate) fn among<'a>(&'a self, available: &[&str]) -> Option<Vec<&'a str>> {
        let has = |name: &&str| available.contains(name);
        let channels = self.channels.iter().map(String::as_str);
        let mut named = self.named.iter().map(|names| names.iter().map(String::as_str).find(has));
        let found: Option<Vec<&str>> = match self.channels.is_empty() {
            true => named.collect(),
            false if channels.clone().all(|name| has(&name)) => {
                Some(channels.chain(named.by_ref().flatten()).collect())
            }
            false => None,
        };
        found.filter(|found| !found.is_empty())
    }
}

impl Recording {
    /// Keeps the channels of the selection alone, in the order of the file, and those that its renames name.
    ///
    /// # Errors
    /// [`RenameError::Unknown`] where the recording lacks a channel of [`Selection::channels`]; then it is as it was.
    pub fn select(&mut self, selection: &Selection) -> Result<(), RenameError> {
        if selection.channels.is_empty() {
            return Ok(());
        }
        if let Some(unknown) = selection.channels.iter().find(|name| self.channel(name).is_none()) {
            return Err(RenameError::Unknown {
                file: self.name.clone(),
                channel: unknown.clone(),
                available: self.channels.iter().map(|c| c.name.clone()).collect(),
            });
        }
        let wanted = |name: &str| {
            selection.channels.iter().chain(selection.named.iter().flatten()).any(|other| other == name)
        };
        let kept: Vec<bool> = self.channels.iter().map(|channel| wanted(&channel.name)).collect();
        for piece in &mut self.pieces {
            let mut flags = kept.iter();
            piece.columns.retain(|_| flags.next().is_some_and(|kept| *kept));
        }
        self.channels.retain(|channel| wanted(&channel.name));
        let told = |finding: &Finding| finding.channel.as_deref().is_none_or(wanted);
        self.warnings.retain(told);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::Channel;

    fn lists(names: &[&[&str]]) -> Vec<Vec<String>> {
        names.iter().map(|list| list.iter().map(|&name| name.to_owned()).collect()).collect()
    }

    #[test]
    fn what_is_named_is_read() {
        let available = ["a", "b", "c"];
        let among = |channels: &[&str], named: &[&[&str]]| {
            let channels = channels.iter().map(|&c| c.to_owned()).collect();
            let selection = Selection { channels, named: lists(named) };
            selection.among(&available).map_or("all".to_owned(), |names| names.join(" "))
        };
        assert_eq!(among(&[], &[]), "all");
        assert_eq!(among(&["b"], &[]), "b");
        assert_eq!(among(&["b"], &[&["c"], &["d"]]), "b c");
        assert_eq!(among(&[], &[&["d", "c"], &["a"]]), "c a", "the first of each list that is there");
        assert_eq!(among(&[], &[&["a"], &["d"]]), "all", "one is missing: the error lists what there is");
        assert_eq!(among(&["a", "d"], &[]), "all");
    }

    #[test]
    fn a_rename_stands_for_the_name_of_the_model() {
        let renames = ["x=a".parse::<Rename>().unwrap()];
        let selection = Selection::of(&[], &renames).with(&renames, lists(&[&["x"], &["f"]]));
        assert_eq!(selection.named, lists(&[&["a"], &["f"]]));
    }

    #[test]
    fn a_recording_keeps_what_is_selected() {
        let time: Vec<f64> = (0..20).map(f64::from).collect();
        let channel = |name: &str, factor: f64| Channel {
            name: name.into(),
            unit: None,
            values: time.iter().map(|t| factor * t).collect(),
        };
        let channels = vec![channel("a", 1.0), channel("b", 2.0), channel("c", 3.0)];
        let mut recording = Recording::from_columns("r", time.clone(), channels).unwrap();
        let unknown = Selection { channels: vec!["d".into()], ..Selection::default() };
        let error = recording.select(&unknown).unwrap_err().to_string();
        assert!(error.contains("no channel `d`; the file has `a`, `b`, `c`"), "{error}");
        let renames = ["x=c".parse::<Rename>().unwrap()];
        recording.select(&Selection::of(&["b".into()], &renames)).unwrap();
        let names: Vec<&str> = recording.channels.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["b", "c"]);
        assert_eq!(recording.pieces[0].columns.len(), 2);
        assert_eq!(recording.pieces[0].columns[1][4], 12.0);
    }
}
