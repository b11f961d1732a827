//! Which rows of a file belong to which episode.

use super::{Meaning, Rows, Shape, Table, meaning};
use crate::error::{Place, RecordingError};
use crate::file::{ROOM, guarded};
use crate::header::{TIMES, header_cell};
use ::parquet::file::reader::ChunkReader;
use std::collections::BTreeSet;

/// Name of the column that numbers the episodes of data sets of robot learning.
const EPISODE: &str = "episode_index";

/// A double has room for every whole number below.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// The episodes of a file, in increasing order, where it makes several recordings; none where it is one.
pub(crate) fn episodes<R: ChunkReader + 'static>(source: R, label: &str) -> Result<Vec<i64>, RecordingError> {
    guarded(label, || several(&Table::open(source, label)?))
}

/// The rows of a file that is one recording.
pub(super) fn only<R: ChunkReader + 'static>(table: &Table<R>, name: &str) -> Result<Rows, RecordingError> {
    let episodes = several(table)?;
    match episodes.is_empty() {
        true => Ok(Rows::all(table.rows())),
        false => Err(RecordingError::SeveralEpisodes {
            place: table.place(),
            file: name.to_owned(),
            column: EPISODE,
            episodes,
        }),
    }
}

/// The rows of an episode, whose number was written so.
pub(super) fn rows<R: ChunkReader + 'static>(
    table: &Table<R>,
    episode: &str,
) -> Result<Rows, RecordingError> {
    // (`+3` and `03` are numbers too, but not what summaries and errors call the episode.)
    let wanted = episode.parse::<i64>().ok().filter(|number| number.to_string() == episode);
    let wanted = wanted.ok_or_else(|| RecordingError::EpisodeNumber {
        place: table.place(),
        found: episode.to_owned(),
        help: "write a whole number after `#`, such as `data.parquet#3`",
    })?;
    let column = numbering(table).ok_or_else(|| RecordingError::NoEpisodes {
        place: table.place(),
        episode: episode.to_owned(),
        found: "the file has no column of numbers `episode_index`",
        help: "name the file without it",
    })?;
    let numbers = numbers(table, column, values(table, column)?)?;
    let mut row = 0;
    let mut runs = Vec::new();
    for run in numbers.chunk_by(|a, b| a == b) {
        if run.first() == Some(&wanted) {
            runs.push(row..row + run.len());
        }
        row += run.len();
    }
    if runs.is_empty() {
        let episodes = distinct(&numbers);
        return Err(RecordingError::NoSuchEpisode {
            place: table.place(),
            wanted,
            column: EPISODE,
            episodes,
        });
    }
    Ok(Rows { runs })
}

/// As [`episodes`].
fn several<R: ChunkReader + 'static>(table: &Table<R>) -> Result<Vec<i64>, RecordingError> {
    let Some(column) = numbering(table) else { return Ok(Vec::new()) };
    let time = TIMES
        .iter()
        .find_map(|time| plain(table, |name, meaning, unit| name == *time && meaning.scale(unit).is_some()));
    let Some(time) = time else { return Ok(Vec::new()) };
    let found = values(table, column)?;
    let is_one = found.windows(2).all(|pair| pair[1] == pair[0]);
    if is_one || values(table, time)?.windows(2).all(|pair| pair[1] > pair[0]) {
        return Ok(Vec::new());
    }
    numbers(table, column, found).map(|numbers| distinct(&numbers))
}

fn distinct(numbers: &[i64]) -> Vec<i64> {
    numbers.iter().copied().collect::<BTreeSet<_>>().into_iter().collect()
}

/// The column that numbers the episodes.
fn numbering<R: ChunkReader + 'static>(table: &Table<R>) -> Option<Plain> {
    let is_number = |meaning| matches!(meaning, Meaning::Number | Meaning::Unsigned);
    plain(table, |name, meaning, _| name == EPISODE && is_number(meaning))
}

/// The values of the column that numbers the episodes as whole numbers.
fn numbers<R: ChunkReader + 'static>(
    table: &Table<R>,
    column: Plain,
    values: Vec<f64>,
) -> Result<Vec<i64>, RecordingError> {
    let whole = |(row, value): (usize, f64)| match value.trunc() == value && value.abs() < EXACT {
        true => Ok(value as i64),
        false => Err(RecordingError::EpisodeNumber {
            place: Place::line(&table.label, row as u64 + 1).column(column.index, EPISODE),
            found: value.to_string(),
            help: "give each row the whole number of its episode",
        }),
    };
    values.into_iter().enumerate().map(whole).collect()
}

/// A column with one number in each row.
#[derive(Clone, Copy)]
struct Plain {
    index: usize,
    shape: Shape,
    meaning: Meaning,
}

/// The first column of such a name, meaning and unit.
fn plain<R: ChunkReader + 'static>(
    table: &Table<R>,
    is_wanted: impl Fn(&str, Meaning, Option<&str>) -> bool,
) -> Option<Plain> {
    let schema = table.schema();
    (0..schema.num_columns()).find_map(|index| {
        let described = schema.column(index);
        let meaning = meaning(&described)?;
        let shape = Shape::of(schema, index).filter(|shape| !shape.is_list)?;
        let (name, unit) = header_cell(&described.path().string(), || table.place()).ok()?;
        is_wanted(&name, meaning, unit.as_deref()).then_some(Plain { index, shape, meaning })
    })
}

/// The numbers of a column in all rows.
fn values<R: ChunkReader + 'static>(table: &Table<R>, column: Plain) -> Result<Vec<f64>, RecordingError> {
    let rows = table.rows();
    if rows.saturating_mul(8) > ROOM {
        return Err(table.too_large(None));
    }
    let cells = table.cells(column.index, column.shape, column.meaning, &Rows::all(rows))?;
    Ok(cells.values)
}
