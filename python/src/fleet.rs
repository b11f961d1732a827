//! Many recordings: the work of one of them for a worker of any engine, and what all say together.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use greybox_commands::fleet::{self, Channels, File, Member, Table};
use greybox_commands::{Failure, loading};
use greybox_diagnose::Options;
use greybox_recording::Location;
use greybox_report::summary::Statistics;
use greybox_report::{Report, ReportError, merge};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::error::raised;
use crate::input::{Model, Recording, rename};
use crate::study::BILLION;
use crate::watch::{STACK, watched};

/// What the diagnoses of all recordings share.
#[pyclass(frozen, module = "greybox._native")]
pub(crate) struct Fleet(Arc<fleet::Fleet>);

/// Name and content of each file of a diagnosis, and its statistics.
type Outcome<'py> = (Vec<(&'static str, Bound<'py, PyBytes>)>, String);

#[pymethods]
impl Fleet {
    /// `holdout` are the files that judge all recordings, path and content; `mechanisms` name and text of those beside
    /// the built-in ones.
    #[new]
    fn new(
        py: Python<'_>,
        model: &Model,
        holdout: Vec<(PathBuf, Vec<u8>)>,
        map: Vec<String>,
        channels: Vec<String>,
        seed: u64,
        work: Option<u64>,
        mechanisms: Vec<(String, String)>,
    ) -> PyResult<Fleet> {
        let loaded = model.loaded();
        let made = py.detach(move || {
            let map = map.iter().map(|text| rename(text)).collect::<Result<_, _>>()?;
            let usual = Options::default();
            let options = Options {
                seed,
                library: match mechanisms.is_empty() {
                    true => None,
                    false => Some(loading::mechanisms_of(&mechanisms, Path::new(""))?.mechanisms),
                },
                work: work.map_or(usual.work, |work| work.saturating_mul(BILLION)),
                terms_only: false,
            };
            let holdout = holdout.into_iter().map(|(path, bytes)| File { path, bytes }).collect();
            let channels = Channels { map, only: channels };
            fleet::Fleet::new(loaded, holdout, channels, options, &mechanisms)
        });
        raised(py, made).map(|fleet| Fleet(Arc::new(fleet)))
    }

    /// The statistics of a finished diagnosis of these inputs; `read` gives the content of a file of its folder, or none.
    fn finished(
        &self,
        path: PathBuf,
        content: Vec<u8>,
        name: &str,
        folder: &str,
        read: &Bound<'_, PyAny>,
    ) -> PyResult<Option<String>> {
        let file = File { path, bytes: content };
        let raised = RefCell::new(None);
        let content = |name: &str| match read.call1((name,)).and_then(|c| c.extract()) {
            Ok(content) => content,
            Err(error) => {
                raised.borrow_mut().get_or_insert(error);
                None
            }
        };
        let found = self.0.finished(Member { file: &file, name, folder }, content);
        match raised.into_inner() {
            Some(error) => Err(error),
            None => found.map(|statistics| text_of(read.py(), &statistics)).transpose(),
        }
    }

    /// Diagnoses the recording in `content`, or `recording` where it was read elsewhere, on so many threads.
    fn diagnose<'py>(
        &self,
        py: Python<'py>,
        path: PathBuf,
        content: Vec<u8>,
        name: String,
        folder: String,
        recording: Option<&Recording>,
        threads: usize,
    ) -> PyResult<Outcome<'py>> {
        let shared = Arc::clone(&self.0);
        let read = recording.map(|recording| recording.0.clone());
        let outcome = watched(py, None, move |watch| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).stack_size(STACK).build();
            let pool = pool.map_err(|e| Failure::internal(format!("no thread could be started: {e}")))?;
            let file = File { path, bytes: content };
            let member = Member { file: &file, name: &name, folder: &folder };
            pool.install(|| match read {
                Some(recording) => shared.diagnose_read(member, recording, watch),
                None => shared.diagnose(member, watch),
            })
        })?;
        let files = outcome.files.iter().map(|(name, content)| (*name, PyBytes::new(py, content))).collect();
        Ok((files, text_of(py, &outcome.statistics)?))
    }
}

/// The content of the recording at a path; of an episode, that of the whole file.
#[pyfunction]
pub(crate) fn content<'py>(py: Python<'py>, path: PathBuf) -> PyResult<Bound<'py, PyBytes>> {
    let content = py.detach(|| loading::content(&path));
    raised(py, content).map(|content| PyBytes::new(py, &content))
}

/// What stands behind the `#` of a path or URL that names an episode of a file.
#[pyfunction]
pub(crate) fn episode(place: PathBuf) -> Option<String> {
    Location::of(place).episode
}

/// The episodes of the file at a path, each a recording of its own; none where it is one, or cannot be read.
#[pyfunction]
pub(crate) fn episodes(py: Python<'_>, path: PathBuf) -> Vec<i64> {
    py.detach(|| greybox_recording::episodes(path)).unwrap_or_default()
}

/// As `episodes`, of the content of a Parquet file; none in a build that reads no Parquet.
#[pyfunction]
pub(crate) fn episodes_of(py: Python<'_>, content: Vec<u8>) -> Vec<i64> {
    #[cfg(feature = "parquet")]
    return py.detach(|| greybox_recording::parse_episodes(content, "")).unwrap_or_default();
    #[cfg(not(feature = "parquet"))]
    {
        let _ = (py, content);
        Vec::new()
    }
}

/// Name and text of the mechanisms of a folder.
#[pyfunction]
pub(crate) fn mechanisms(py: Python<'_>, folder: PathBuf) -> PyResult<Vec<(String, String)>> {
    raised(py, loading::mechanisms(&folder)).map(|own| own.texts)
}

/// The statistics of the text of a report.json.
#[pyfunction]
#[pyo3(signature = (name, page, report))]
pub(crate) fn statistics(py: Python<'_>, name: &str, page: Option<&str>, report: &str) -> PyResult<String> {
    let report = Report::from_json(report).map_err(|e| {
        Failure::input(format!("the report of {name} is no report.json: {e}"))
            .help("give the result of `greybox.diagnose`, or the text of its report.json")
    });
    text_of(py, &merge::map(name, page, &raised(py, report)?))
}

/// The statistics of a recording that could not be diagnosed.
#[pyfunction]
#[pyo3(signature = (name, message, help))]
pub(crate) fn failed(py: Python<'_>, name: &str, message: &str, help: Option<&str>) -> PyResult<String> {
    text_of(py, &merge::failed(name, message, help))
}

/// Joins statistics.
#[pyfunction]
pub(crate) fn reduce(py: Python<'_>, parts: Vec<String>) -> PyResult<String> {
    let parts = statistics_of(py, &parts)?;
    let joined = py.detach(|| merge::reduce(parts));
    text_of(py, &raised(py, joined.map_err(fleet::unwritten))?)
}

/// Sees that a table of recordings can be read and has these.
#[pyfunction]
pub(crate) fn check_table(py: Python<'_>, text: &str, file: &str, recordings: Vec<String>) -> PyResult<()> {
    raised(py, Table::new(text, file, recordings.iter().map(String::as_str)).map(drop))
}

/// The text of summary.json, its story, and the page; `table` is the text of a table of the recordings, and what errors
/// call it.
#[pyfunction]
#[pyo3(signature = (parts, table, name, file, seed))]
pub(crate) fn conclude(
    py: Python<'_>,
    parts: Vec<String>,
    table: Option<(String, String)>,
    name: &str,
    file: &str,
    seed: u64,
) -> PyResult<(String, String, String)> {
    let parts = statistics_of(py, &parts)?;
    let concluded = py.detach(|| {
        let table = table.map(|(text, file)| Table::new(&text, &file, [])).transpose()?;
        fleet::conclude(parts, table.as_ref(), name, file, seed)
    });
    raised(py, concluded).map(|c| (c.json, c.story, c.html))
}

fn text_of(py: Python<'_>, statistics: &Statistics) -> PyResult<String> {
    raised(py, serde_json::to_string(statistics).map_err(|e| fleet::unwritten(ReportError::from(e))))
}

fn statistics_of(py: Python<'_>, texts: &[String]) -> PyResult<Vec<Statistics>> {
    let read = |text: &String| {
        serde_json::from_str(text).map_err(|e| Failure::input(format!("these are no statistics: {e}")))
    };
    raised(py, texts.iter().map(read).collect())
}
