//! Why a recording could not be read or written: the place, what was found there, the fix.

use std::fmt;

/// Where in a file: `file:line:column name`, the parts that are known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// The file as the caller named it.
    pub file: String,
    /// Line of the file, counted from 1 (the header is line 1).
    pub line: Option<u64>,
    /// Column number, counted from 1, and the column's name.
    pub column: Option<(usize, String)>,
}

impl Place {
    pub(crate) fn file(file: &str) -> Self {
        Self { file: file.to_owned(), line: None, column: None }
    }

    pub(crate) fn line(file: &str, line: u64) -> Self {
        Self { file: file.to_owned(), line: Some(line), column: None }
    }

    pub(crate) fn column(mut self, index: usize, name: &str) -> Self {
        self.column = Some((index + 1, name.to_owned()));
        self
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some((number, name)) = &self.column {
            let colon = if name.is_empty() { "" } else { ":" };
            write!(f, "{colon}{name} (column {number})")?;
        }
        Ok(())
    }
}

/// `1 row`, `2 rows`.
fn counted(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

/// How several episodes of a file are named at once: their first run without a gap, as a shell expands it.
fn several(file: &str, episodes: &[i64]) -> String {
    match episodes.chunk_by(|a, b| b.wrapping_sub(*a) == 1).find(|run| run.len() > 1) {
        Some([first, .., last]) => format!("which a shell expands: `{file}#{{{first}..{last}}}`"),
        _ => "one after the other".to_owned(),
    }
}

/// Why a recording could not be read or written. Each message is one paragraph: place, what was found, fix.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file does not exist.
    #[error("{place}: no such file; check the path and the spelling")]
    NotFound {
        /// The file as named by the caller.
        place: Place,
    },
    /// A folder was given where a file is needed.
    #[error("{place}: this is a folder, not a recording; name one CSV file inside it")]
    IsDirectory {
        /// The folder as named by the caller.
        place: Place,
    },
    /// A device was given where a file is needed; some have no end.
    #[error("{place}: this is a device, not a file; name a recording")]
    IsDevice {
        /// The device as named by the caller.
        place: Place,
    },
    /// The operating system refused to read or write.
    #[error("{place}: the file could not be {action}: {source}; check its permissions and the disk")]
    Io {
        /// The file as named by the caller.
        place: Place,
        /// `read` or `written`.
        action: &'static str,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// The bytes are not UTF-8 text.
    #[error("{place}: the file is not UTF-8 text ({found}); save it again as `CSV UTF-8`")]
    NotUtf8 {
        /// The file, and the line of the first offending byte.
        place: Place,
        /// What was found instead.
        found: String,
    },
    /// There is nothing in the file.
    #[error(
        "{place}: the file is empty; a recording starts with a header row such as `t,u [V],y [m]`, followed \
         by one row per sample"
    )]
    Empty {
        /// The file.
        place: Place,
    },
    /// The columns are separated by something else than a comma.
    #[error(
        "{place}: the columns are separated by {found}; greybox reads comma-separated files with a decimal \
         point: {help}"
    )]
    Separator {
        /// The header line.
        place: Place,
        /// `semicolons`, `tabs`, ….
        found: &'static str,
        /// How to convert this file.
        help: &'static str,
    },
    /// A number is written with a decimal comma.
    #[error(
        "{place}: {found} looks like a decimal comma; write numbers with a decimal point (0.5, not 0,5), for \
         example by exporting with an English number format"
    )]
    DecimalComma {
        /// The row, and the cell where it is one cell.
        place: Place,
        /// The offending text.
        found: String,
    },
    /// The first row holds numbers.
    #[error(
        "{place}: the first row holds numbers ({found}), so the header row is missing; add one such as \
         `t,u [V],y [m]` as the first line"
    )]
    NoHeader {
        /// The first line.
        place: Place,
        /// The first cell.
        found: String,
    },
    /// The first column is not the time `t`.
    #[error(
        "{place}: the first column must be the time `t` in seconds, found `{found}`; {help} (accepted: `t`, \
         `t [s]`, `t [ms]`, `t [us]`)"
    )]
    TimeColumn {
        /// The header line.
        place: Place,
        /// The header of the first column.
        found: String,
        /// How to fix this header.
        help: String,
    },
    /// There is a time and nothing else.
    #[error("{place}: there is no column beside the time; add at least one channel, such as `y [m]`")]
    NoChannels {
        /// The header line.
        place: Place,
    },
    /// A header cell is empty or its brackets do not close.
    #[error("{place}: the header cell `{found}` is not `name` or `name [unit]`; {help}")]
    HeaderCell {
        /// The header line and column.
        place: Place,
        /// The cell as written.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// Two columns share a name.
    #[error(
        "{place}: the name `{name}` already stands in column {first}; rename or delete one of the two columns"
    )]
    DuplicateName {
        /// The header line and the second column.
        place: Place,
        /// The name.
        name: String,
        /// Number of the first column of that name, counted from 1.
        first: usize,
    },
    /// Names given to the columns of lines that have no header do not fit.
    #[error("{place}: {found}; {help}")]
    Columns {
        /// What names them, or the row that has other ones.
        place: Place,
        /// What is wrong.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// A row has more or fewer cells than the header.
    #[error(
        "{place}: the row has {}, the header has {expected}; {help}",
        counted(*found, "cell")
    )]
    CellCount {
        /// The row.
        place: Place,
        /// Cells in the row.
        found: usize,
        /// Cells in the header.
        expected: usize,
        /// How to fix it.
        help: &'static str,
    },
    /// A cell holds text where a number is needed.
    #[error("{place}: `{found}` is not a number; {help}")]
    NotANumber {
        /// The cell.
        place: Place,
        /// The cell as written.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// A cell holds `NaN` or an infinity.
    #[error("{place}: `{found}` is not a measured value; leave the cell empty for a missing sample")]
    NotFinite {
        /// The cell.
        place: Place,
        /// The cell as written.
        found: String,
    },
    /// Squares of the values, or the sampling's frequencies, would leave the range of numbers.
    #[error(
        "{place}: {what} of {found:e} is outside the supported range (1e-100 to 1e100); check the export, or write the \
         column in another unit"
    )]
    Scale {
        /// The file and the column.
        place: Place,
        /// `a value` or `a sampling step`.
        what: &'static str,
        /// Its size.
        found: f64,
    },
    /// A row has no time.
    #[error("{place}: the time is missing; every row needs its time, delete the row or fill in the cell")]
    MissingTime {
        /// The cell.
        place: Place,
    },
    /// A date among numbers, a number among dates, or an offset from UTC at some of the dates alone.
    #[error(
        "{place}: `{found}` is no time like those before it; write all as numbers, or all as dates of one kind"
    )]
    TimesDiffer {
        /// The cell.
        place: Place,
        /// The cell as written.
        found: String,
    },
    /// The time repeats or runs backwards.
    #[error(
        "{place}: the time {found} s does not come after the time {previous} s of the row before; {help}"
    )]
    TimeNotIncreasing {
        /// The cell.
        place: Place,
        /// Time of the row, s.
        found: f64,
        /// Time of the row before, s.
        previous: f64,
        /// How to fix it.
        help: &'static str,
    },
    /// Too few rows to identify anything.
    #[error("{place}: the recording has {} of samples, at least {needed} are needed; {help}", counted(*rows, "row"))]
    TooFewRows {
        /// The file.
        place: Place,
        /// Rows found.
        rows: usize,
        /// Rows needed.
        needed: usize,
        /// How to fix it.
        help: &'static str,
    },
    /// Gaps leave no piece that is long enough.
    #[error(
        "{place}: gaps in the time cut the recording into {pieces} pieces, none of them with {needed} samples; \
         check the time column, or record without dropping samples"
    )]
    NoUsablePiece {
        /// The file.
        place: Place,
        /// Pieces found.
        pieces: usize,
        /// Samples a piece needs.
        needed: usize,
    },
    /// This build of greybox leaves the format out.
    #[error(
        "{place}: this build of greybox does not read {format}: build it with the feature `{feature}` (`cargo install \
         --features {feature} …`), or {instead}"
    )]
    NotBuiltIn {
        /// The file.
        place: Place,
        /// `MAT-files`, ….
        format: &'static str,
        /// Name of the feature.
        feature: &'static str,
        /// What to do without it.
        instead: &'static str,
    },
    /// The file is of another format than its name says, or of a version that is not read.
    #[error("{place}: {found}, which greybox does not read; {help}")]
    Format {
        /// The file.
        place: Place,
        /// What it is.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// The file is cut off, or bytes of it were changed.
    #[error(
        "{place}: the file is damaged{}: {found}; copy it again from where it was recorded, or write it again",
        variable.as_ref().map(|v| format!(" in the variable `{v}`")).unwrap_or_default()
    )]
    Damaged {
        /// The file.
        place: Place,
        /// The variable or column, where that is known.
        variable: Option<String>,
        /// What was found.
        found: String,
    },
    /// The values of the file need more memory than greybox gives a file.
    #[error(
        "{place}: its values need more than {limit_gib} GiB unpacked{}; save fewer variables, or several shorter files",
        variable.as_ref().map(|v| format!(" (at the variable `{v}`)")).unwrap_or_default()
    )]
    TooLarge {
        /// The file.
        place: Place,
        /// The variable at which the limit was met, where that is known.
        variable: Option<String>,
        /// The limit, GiB.
        limit_gib: u64,
    },
    /// No variable or column is the time.
    #[error("{place}: there is no time among what the file holds ({found}); {help}")]
    NoTime {
        /// The file.
        place: Place,
        /// The variables or columns, in words.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// A signal may belong to several times of the file.
    #[error(
        "{place}: `{signal}` may belong to any of the times {}; save each time with its signals in a structure or group of \
         its own, or name the channels to read with `--channels`",
        times.join(", ")
    )]
    SeveralTimes {
        /// The file.
        place: Place,
        /// The signal.
        signal: String,
        /// The variables that are times.
        times: Vec<String>,
    },
    /// No topic or group of the file holds numbers that can be read.
    #[error(
        "{place}: the file holds no series of numbers that can be read ({found}); record topics of numbers, as ROS 2 (CDR), \
         ROS 1 or JSON write them"
    )]
    NoSeries {
        /// The file.
        place: Place,
        /// What there is instead, in words.
        found: String,
    },
    /// Signals of the file were recorded at different times.
    #[error(
        "{place}: `{late}` begins at {begin} s, after `{early}` has ended at {end} s, so that no instant has a value of both; \
         name those that belong together with `--channels`"
    )]
    NoOverlap {
        /// The file.
        place: Place,
        /// The clock that begins last.
        late: String,
        /// Its first time, s after the first of the file.
        begin: f64,
        /// The clock that ends first.
        early: String,
        /// Its last time, s after the first of the file.
        end: f64,
    },
    /// The times restart with every episode of a data set.
    #[error(
        "{place}: the file holds {} ({}; column `{column}`), each a recording with times of its own; name one, \
         `{file}#{}`, or several, {}; a folder of recordings takes each by itself: `greybox diagnose MODEL.toml FOLDER`",
        counted(episodes.len(), "episode"),
        crate::finding::in_words(episodes),
        episodes.first().copied().unwrap_or_default(),
        several(file, episodes)
    )]
    SeveralEpisodes {
        /// The file.
        place: Place,
        /// Its name without its folder.
        file: String,
        /// The column that numbers the episodes.
        column: &'static str,
        /// The episodes, in increasing order.
        episodes: Vec<i64>,
    },
    /// The file has episodes, but not this one.
    #[error(
        "{place}: the file has no episode {wanted}; name one of those in its column `{column}`: {}",
        crate::finding::in_words(episodes)
    )]
    NoSuchEpisode {
        /// The recording as named by the caller.
        place: Place,
        /// The episode that was named.
        wanted: i64,
        /// The column that numbers the episodes.
        column: &'static str,
        /// Those that are there, in increasing order.
        episodes: Vec<i64>,
    },
    /// An episode was named of a file that has none.
    #[error("{place}: `#{episode}` names an episode, but {found}; {help}")]
    NoEpisodes {
        /// The recording as named by the caller.
        place: Place,
        /// What stands behind `#`.
        episode: String,
        /// What the file is instead.
        found: &'static str,
        /// How to fix it.
        help: &'static str,
    },
    /// Something else than a whole number in the place of the number of an episode.
    #[error("{place}: `{found}` is not the number of an episode; {help}")]
    EpisodeNumber {
        /// The recording as named by the caller, or the cell.
        place: Place,
        /// What was found instead.
        found: String,
        /// How to fix it.
        help: &'static str,
    },
    /// There is a time, and no variable or column has a value for each.
    #[error(
        "{place}: no other variable has the {rows} values of the time `{time}` ({found}); save signals and time with one \
         value per sample"
    )]
    NoSignals {
        /// The file.
        place: Place,
        /// The time.
        time: String,
        /// Its length.
        rows: usize,
        /// The other variables or columns, in words.
        found: String,
    },
    /// A column to be built or written has another length than the time.
    #[error("{place}: the column has {found} values, the time has {expected}; give one value per time")]
    ColumnLength {
        /// File and column.
        place: Place,
        /// Values in the column.
        found: usize,
        /// Values in the time.
        expected: usize,
    },
}

impl RecordingError {
    /// Where it went wrong.
    pub fn place(&self) -> &Place {
        match self {
            Self::NotFound { place }
            | Self::IsDirectory { place }
            | Self::IsDevice { place }
            | Self::Io { place, .. }
            | Self::NotUtf8 { place, .. }
            | Self::Empty { place }
            | Self::Separator { place, .. }
            | Self::DecimalComma { place, .. }
            | Self::NoHeader { place, .. }
            | Self::TimeColumn { place, .. }
            | Self::NoChannels { place }
            | Self::HeaderCell { place, .. }
            | Self::DuplicateName { place, .. }
            | Self::Columns { place, .. }
            | Self::CellCount { place, .. }
            | Self::NotANumber { place, .. }
            | Self::NotFinite { place, .. }
            | Self::Scale { place, .. }
            | Self::MissingTime { place }
            | Self::TimesDiffer { place, .. }
            | Self::TimeNotIncreasing { place, .. }
            | Self::TooFewRows { place, .. }
            | Self::NoUsablePiece { place, .. }
            | Self::NotBuiltIn { place, .. }
            | Self::Format { place, .. }
            | Self::Damaged { place, .. }
            | Self::TooLarge { place, .. }
            | Self::NoTime { place, .. }
            | Self::SeveralTimes { place, .. }
            | Self::NoSeries { place, .. }
            | Self::NoOverlap { place, .. }
            | Self::SeveralEpisodes { place, .. }
            | Self::NoSuchEpisode { place, .. }
            | Self::NoEpisodes { place, .. }
            | Self::EpisodeNumber { place, .. }
            | Self::NoSignals { place, .. }
            | Self::ColumnLength { place, .. } => place,
        }
    }
}
