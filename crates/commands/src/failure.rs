//! The one error of a command: what is wrong, where, and the fix.

use std::fmt::Write as _;
use std::ops::Range;
use std::path::Path;

use greybox_calibrate::DataError;
use greybox_diagnose::{DiagnoseError, MechanismError};
use greybox_fleet::RunsError;
use greybox_identify::IdentifyError;
use greybox_model::{ModelError, nearest};
use greybox_recording::{RecordingError, RenameError};
use serde_json::{Map, Value, json};

/// Why a command did not finish.
#[derive(Debug)]
pub struct Failure(Box<Details>);

#[derive(Debug)]
struct Details {
    cause: Cause,
    /// What is wrong, with the file where that is known.
    message: String,
    help: Option<String>,
    /// Place for machines: `file`, `line`, `column`, `channel`.
    place: Map<String, Value>,
    excerpt: Option<Excerpt>,
}

/// Who can fix it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cause {
    /// The caller: exit 2.
    BadInput,
    /// The developers, or the machine: exit 1.
    Internal,
}

/// The source line that an error points at.
#[derive(Debug)]
struct Excerpt {
    /// `file:line:column`.
    place: String,
    line: usize,
    text: String,
    /// Characters of `text` to underline.
    marked: Range<usize>,
}

impl Failure {
    fn new(cause: Cause, message: impl Into<String>) -> Failure {
        Failure(Box::new(Details {
            cause,
            message: plain(&message.into()),
            help: None,
            place: Map::new(),
            excerpt: None,
        }))
    }

    /// Bad input.
    pub fn input(message: impl Into<String>) -> Failure {
        Failure::new(Cause::BadInput, message)
    }

    /// Bad input, in the file at `path`: the message names it.
    pub fn file(path: &Path, message: impl std::fmt::Display) -> Failure {
        let file = path.display().to_string();
        Failure::input(format!("{file}: {message}")).at("file", file)
    }

    /// A diagnosis or calibration of the model at `path` that could not be made.
    pub fn diagnosis(path: &Path, error: DiagnoseError) -> Failure {
        match error {
            DiagnoseError::Setup(error) => Failure::file(path, error),
            other => other.into(),
        }
    }

    /// A fault of greybox or of the machine.
    pub fn internal(message: impl Into<String>) -> Failure {
        Failure::new(Cause::Internal, message)
    }

    /// A panic, of which the default hook has said where.
    pub fn fault() -> Failure {
        Failure::internal("internal error; please report the lines above")
    }

    /// Adds the fix.
    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Failure {
        self.0.help = Some(plain(&help.into()));
        self
    }

    #[must_use]
    fn at(mut self, key: &str, value: impl Into<Value>) -> Failure {
        self.0.place.insert(key.to_owned(), value.into());
        self
    }

    /// A fault of the model in `text`, shown with its source line.
    pub fn model(error: &ModelError, text: &str) -> Failure {
        let (Some(file), Some(span), Some((line, column))) =
            (error.file(), error.span(), error.line_column())
        else {
            return Failure::in_model(error.file(), &error.problem().to_string(), error.help());
        };
        let mut failure = Failure::in_model(None, &error.problem().to_string(), error.help())
            .at("file", file)
            .at("line", line)
            .at("column", column);
        failure.0.excerpt = Some(Excerpt::new(text, &span, format!("{file}:{line}:{column}"), line, column));
        failure
    }

    /// A fault of a mechanism among `files` (name, text) of `folder`, shown with its source line. The message
    /// holds its own fix.
    pub fn mechanism(error: &MechanismError, files: &[(String, String)], folder: &Path) -> Failure {
        let Some((name, text)) = files.iter().find(|(name, _)| *name == error.file) else {
            // A built-in file speaks of a kind that a file of the folder has replaced.
            return Failure::file(
                folder,
                format!(
                    "the built-in {} no longer fits what these files replace: {}",
                    error.file, error.message
                ),
            )
            .help("keep the parameters' names of a built-in mechanism, or give the file another name");
        };
        let path = folder.join(name);
        let mut failure = Failure::file(&path, &error.message);
        if let Some(line) = error.line {
            let source = text.lines().nth(line - 1).unwrap_or_default();
            let column = 1 + source.chars().take_while(|c| c.is_whitespace()).count();
            let start: usize = text.split_inclusive('\n').take(line - 1).map(str::len).sum();
            let place = format!("{}:{line}", path.display());
            failure = failure.at("line", line);
            failure.0.excerpt =
                Some(Excerpt::new(text, &(start + column - 1..start + source.len()), place, line, column));
        }
        failure
    }

    fn in_model(file: Option<&str>, problem: &str, help: Option<&str>) -> Failure {
        let mut failure = match file {
            Some(file) => Failure::file(Path::new(file), problem),
            None => Failure::input(problem),
        };
        failure.0.help = help.map(plain);
        failure
    }

    /// Nothing could be done because of `failures`, each of one file.
    pub fn all(folder: &Path, message: &str, failures: &[Failure]) -> Failure {
        let reported: String = failures
            .iter()
            .map(|f| match &f.0.help {
                Some(help) => format!("\n  {}\n    help: {help}", f.0.message),
                None => format!("\n  {}", f.0.message),
            })
            .collect();
        let mut failure = Failure::file(folder, format!("{message}:{reported}"));
        // A fault of greybox in all of them is no bad input.
        if !failures.is_empty() && failures.iter().all(|f| f.0.cause == Cause::Internal) {
            failure.0.cause = Cause::Internal;
        }
        failure
    }

    /// What is wrong.
    pub fn message(&self) -> &str {
        &self.0.message
    }

    /// What to do about it, where the message does not say.
    pub fn advice(&self) -> Option<&str> {
        self.0.help.as_deref()
    }

    /// Exit status: 2 for bad input, 1 for an internal error or a fault of the machine.
    pub fn code(&self) -> u8 {
        match self.0.cause {
            Cause::BadInput => 2,
            Cause::Internal => 1,
        }
    }

    /// For machines.
    pub fn to_json(&self) -> Value {
        let mut error = Map::new();
        let kind = match self.0.cause {
            Cause::BadInput => "bad_input",
            Cause::Internal => "internal",
        };
        error.insert("kind".to_owned(), json!(kind));
        error.insert("exit_code".to_owned(), json!(self.code()));
        error.insert("message".to_owned(), json!(self.0.message));
        error.extend(self.0.place.clone());
        if let Some(help) = &self.0.help {
            error.insert("help".to_owned(), json!(help));
        }
        json!({ "error": error })
    }
}

/// As printed, with a final newline.
impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "error: {}", self.0.message)?;
        let gutter = match &self.0.excerpt {
            None => String::from(" "),
            Some(excerpt) => excerpt.write(f)?,
        };
        match &self.0.help {
            Some(help) => writeln!(f, "{gutter} help: {help}"),
            None => Ok(()),
        }
    }
}

/// Longest line of a source that is shown, and most of a quotation, in characters.
const WIDEST: usize = 100;
/// What is shown of a longer line before its mark.
const BEFORE: usize = 40;

/// A character of a source as a terminal may show it.
fn shown(c: char) -> char {
    if c.is_control() && c != '\t' { '\u{fffd}' } else { c }
}

/// Text of which nothing acts on a terminal, with long quotations (between backticks) cut.
fn plain(text: &str) -> String {
    let parts: Vec<String> = text
        .split('`')
        .enumerate()
        .map(|(k, part)| match part.char_indices().nth(WIDEST) {
            Some((end, _)) if k % 2 == 1 => format!("{}…", &part[..end]),
            _ => part.to_owned(),
        })
        .collect();
    let mut shown = String::with_capacity(text.len());
    for c in parts.join("`").chars() {
        match c {
            '\n' => shown.push(c),
            c if c.is_control() => shown.extend(c.escape_unicode()),
            c => shown.push(c),
        }
    }
    shown
}

impl Excerpt {
    fn new(text: &str, span: &Range<usize>, place: String, line: usize, column: usize) -> Excerpt {
        let source: Vec<char> = text.lines().nth(line - 1).unwrap_or_default().chars().map(shown).collect();
        let start = (column - 1).min(source.len());
        let chars =
            text.get(span.clone()).and_then(|marked| marked.lines().next()).map_or(0, |m| m.chars().count());
        let end = start + chars.min(source.len() - start).max(1);
        // Of a long line, the part around its mark.
        let from = if source.len() > WIDEST { start.saturating_sub(BEFORE) } else { 0 };
        let to = source.len().min(from + WIDEST);
        let (head, tail) = (if from > 0 { "…" } else { "" }, if to < source.len() { "…" } else { "" });
        let text = format!("{head}{}{tail}", source[from..to].iter().collect::<String>());
        let shift = |at: usize| at - from + head.chars().count();
        Excerpt { place, line, text, marked: shift(start)..shift(end.min(to.max(start + 1))) }
    }

    /// Writes the excerpt; returns the empty gutter for the lines that follow.
    fn write(&self, f: &mut std::fmt::Formatter<'_>) -> Result<String, std::fmt::Error> {
        let number = self.line.to_string();
        let gutter = " ".repeat(number.len());
        // Tabs stay tabs, so that the mark stands under the text in any terminal.
        let mut under = String::new();
        for c in self.text.chars().take(self.marked.start) {
            under.push(if c == '\t' { '\t' } else { ' ' });
        }
        write!(under, "{}", "^".repeat(self.marked.len()))?;
        writeln!(f, "{gutter}--> {}", self.place)?;
        writeln!(f, "{gutter} |")?;
        writeln!(f, "{number} | {}", self.text)?;
        writeln!(f, "{gutter} | {under}")?;
        Ok(format!("{gutter} ="))
    }
}

/// The message holds its own fix.
impl From<RecordingError> for Failure {
    fn from(error: RecordingError) -> Failure {
        let place = error.place();
        let mut failure = Failure::input(error.to_string()).at("file", place.file.as_str());
        if let Some(line) = place.line {
            failure = failure.at("line", line);
        }
        if let Some((number, name)) = &place.column {
            failure = failure.at("column", *number).at("channel", name.as_str());
        }
        failure
    }
}

/// The message holds its own fix, but for the name that was meant.
impl From<RunsError> for Failure {
    fn from(error: RunsError) -> Failure {
        Failure::input(error.to_string())
    }
}

impl From<RenameError> for Failure {
    fn from(error: RenameError) -> Failure {
        let failure = Failure::input(error.to_string());
        match error {
            RenameError::Unknown { file, channel, available } => {
                let help = match nearest(&channel, available.iter().map(String::as_str)) {
                    Some(near) => format!("did you mean `{near}`?"),
                    None => "name one of these with `--channels`, or after the `=` of `--map`".to_owned(),
                };
                failure.at("file", file).at("channel", channel).help(help)
            }
            RenameError::Unit { file, channel, .. } | RenameError::Taken { file, name: channel } => {
                failure.at("file", file).at("channel", channel)
            }
            _ => failure,
        }
    }
}

/// The message holds its own fix.
impl From<DataError> for Failure {
    fn from(error: DataError) -> Failure {
        let failure = Failure::input(error.to_string());
        match error {
            DataError::MissingChannel { file, channel, .. }
            | DataError::Unit { file, channel, .. }
            | DataError::UnreadableUnit { file, channel, .. }
            | DataError::EmptyChannel { file, channel }
            | DataError::OutOfRange { file, channel, .. } => failure.at("file", file).at("channel", channel),
            _ => failure,
        }
    }
}

/// A mechanism of the built-in library that cannot be read is an internal error.
impl From<DiagnoseError> for Failure {
    fn from(error: DiagnoseError) -> Failure {
        match error {
            DiagnoseError::Data(error) => error.into(),
            DiagnoseError::Mechanism(error) => Failure::internal(error.to_string()),
            other => Failure::input(other.to_string()),
        }
    }
}

/// The message holds its own fix. A model error here is about equations that greybox wrote, so that there is
/// no file to point at: what it says of names and units comes from the recordings' headers.
impl From<IdentifyError> for Failure {
    fn from(error: IdentifyError) -> Failure {
        let message = error.to_string();
        match error {
            IdentifyError::Data(DataError::MissingChannel { file, channel, available, .. }) => {
                let message = format!("there is no channel `{channel}`; the file has {available}");
                Failure::file(Path::new(&file), message)
                    .help("name channels of the recordings after --states and --inputs")
                    .at("channel", channel)
            }
            IdentifyError::Data(error) => error.into(),
            IdentifyError::Model(error) => {
                let failure =
                    Failure::input(format!("the recordings' channels make no equation: {}", error.problem()));
                match error.help() {
                    Some(help) => failure.help(help),
                    None => failure.help("check names and units in the headers of the recordings"),
                }
            }
            IdentifyError::Twice { name, .. }
            | IdentifyError::Name { name, .. }
            | IdentifyError::DelayedState { name, .. }
            | IdentifyError::LateInput { name, .. }
            | IdentifyError::TwoDeadTimes { name }
            | IdentifyError::Still { name } => Failure::input(message).at("channel", name),
            _ => Failure::input(message),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_error_points_at_its_place() {
        let text = "[states]\nx = { unit = \"m\" }\n[parameters]\nm = { value = 1, unit = \"kg\" }\n\
                    [equations]\nbody = \"mm*x'' = 0\"\n";
        let error = greybox_model::Model::from_toml(text, "a.toml").unwrap_err();
        let failure = Failure::model(&error, text);
        let shown = failure.to_string();
        assert!(shown.contains("\n --> a.toml:6:9\n"), "{shown}");
        assert!(shown.contains("\n6 | body = \"mm*x'' = 0\"\n  |         ^^\n"), "{shown}");
        assert_eq!(failure.to_json()["error"]["line"], 6);
        assert_eq!(failure.code(), 2);
    }

    #[test]
    fn the_mark_stays_within_its_line_and_keeps_tabs() {
        let text = "\tab\ncd";
        let excerpt = Excerpt::new(text, &(1..6), "f:1:2".into(), 1, 2);
        assert_eq!(excerpt.marked, 1..3);
        let mut failure = Failure::input("wrong").help("right");
        failure.0.excerpt = Some(excerpt);
        assert_eq!(
            failure.to_string(),
            "error: wrong\n --> f:1:2\n  |\n1 | \tab\n  | \t^^\n  = help: right\n"
        );
    }

    #[test]
    fn a_long_line_is_cut_around_its_mark() {
        let text = format!("{}oops{}", "a".repeat(300), "b".repeat(300));
        let excerpt = Excerpt::new(&text, &(300..304), "f:1:301".into(), 1, 301);
        assert_eq!(excerpt.text, format!("…{}oops{}…", "a".repeat(40), "b".repeat(56)));
        assert_eq!(excerpt.marked, 41..45);
        let excerpt = Excerpt::new(&text, &(0..604), "f:1:1".into(), 1, 1);
        assert_eq!(excerpt.marked, 0..100);
        assert_eq!(excerpt.text.chars().count(), 101);
    }

    #[test]
    fn nothing_acts_on_the_terminal() {
        let failure = Failure::input(format!("bad\u{1b}[31m `{}` \nmore", "x".repeat(200)));
        assert_eq!(failure.to_string(), format!("error: bad\\u{{1b}}[31m `{}…` \nmore\n", "x".repeat(100)));
        assert_eq!(Excerpt::new("a\u{0}b", &(0..1), "f:1:1".into(), 1, 1).text, "a\u{fffd}b");
    }

    #[test]
    fn an_empty_span_still_shows() {
        assert_eq!(Excerpt::new("", &(0..0), "f:1:1".into(), 1, 1).marked, 0..1);
    }
}
