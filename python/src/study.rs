//! The commands that learn from recordings.

use greybox_calibrate::Data;
use greybox_commands::{Failure, calibrate as calibration, check as checks, diagnose as diagnosis};
use greybox_commands::{identify as identification, loading, simulate as simulation};
use greybox_diagnose::Options;
use greybox_identify::{DeadTime, DelayedState, Library, Monomials};
use greybox_model::Model as Equations;
use greybox_report::convert::identification::Sources as Told;
use greybox_report::page;
use numpy::{PyArray1, ToPyArray};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use std::path::PathBuf;

use crate::error::raised;
use crate::input::{Model, Recordings, Source, Sources, hold};
use crate::watch::watched;

/// Work is asked for in these.
pub(crate) const BILLION: u64 = 1_000_000_000;

/// Report, story, page, model and recordings of a study.
type Studied<'py> = (String, String, Option<String>, String, Bound<'py, PyList>);

/// Reads the recordings and sees that they fit the model, as the command does.
fn fitting(sources: Sources, model: &Equations) -> Result<Recordings, Failure> {
    let recordings = sources.of_model(model).read()?;
    Data::new(model, &recordings.train)?;
    Data::new(model, &recordings.holdout)?;
    Ok(recordings)
}

#[pyfunction]
#[pyo3(signature = (model, train, holdout, map, channels, seed, work, mechanisms, terms_only, progress))]
pub(crate) fn diagnose<'py>(
    py: Python<'py>,
    model: &Model,
    train: Vec<Source>,
    holdout: Vec<Source>,
    map: Vec<String>,
    channels: Vec<String>,
    seed: u64,
    work: Option<u64>,
    mechanisms: Option<PathBuf>,
    terms_only: bool,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Studied<'py>> {
    let loaded = model.loaded();
    let sources = raised(py, Sources::new(train, holdout, map, &channels))?;
    let results = watched(py, progress, move |watch| {
        let own = mechanisms.as_deref().map(loading::mechanisms).transpose()?;
        let Recordings { train, holdout } = fitting(sources, &loaded.model)?;
        let usual = Options::default();
        let options = Options {
            seed,
            library: own.map(|own| own.library.mechanisms),
            work: work.map_or(usual.work, |work| work.saturating_mul(BILLION)),
            terms_only,
        };
        let found = greybox_diagnose::diagnose(&loaded.model, &train, &holdout, &options, watch)
            .map_err(|e| Failure::diagnosis(&loaded.path, e))?;
        watch.stage("writing the report");
        diagnosis::Results::of(&found, &loaded, &train, &holdout)
    })?;
    let recordings = curves(py, &results.recordings)?;
    Ok((results.report_json, results.story, Some(results.report_html), results.improved_toml, recordings))
}

/// As the arguments of `greybox identify`; `library` holds the names of parts.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct Wanted {
    states: Vec<String>,
    inputs: Vec<String>,
    order: Option<usize>,
    library: Vec<String>,
    terms: Vec<String>,
    derivatives: Vec<usize>,
    hold: Option<String>,
    delay: Option<String>,
    gain: Option<f64>,
    longest: f64,
    dead_time: Vec<(String, Option<f64>)>,
    replicates: usize,
    seed: u64,
}

impl Wanted {
    fn options(&self) -> Result<greybox_identify::Options, Failure> {
        fn borrowed(names: &[String]) -> Vec<&str> {
            names.iter().map(String::as_str).collect()
        }
        if self.replicates == 0 {
            return Err(Failure::input("no replicates leave nothing to count inclusions on")
                .help("ask for at least one"));
        }
        if let Some(order) = self.derivatives.iter().find(|order| !(1..=2).contains(*order)) {
            return Err(Failure::input(format!("`derivatives` is {order}"))
                .help("2 for mechanics, 1 for first-order systems"));
        }
        let usual = greybox_identify::Options::new(&borrowed(&self.states), &borrowed(&self.inputs));
        let delay = self.delay.as_ref().map(|state| DelayedState {
            state: state.clone(),
            gain: self.gain,
            longest: self.longest,
        });
        Ok(greybox_identify::Options {
            derivatives: self.derivatives.clone(),
            library: self.parts(usual.library.monomials)?,
            order: self.order.unwrap_or(usual.order),
            hold: self.hold.as_deref().map(hold).transpose()?,
            delay,
            dead_times: self
                .dead_time
                .iter()
                .map(|(input, longest)| DeadTime { input: input.clone(), longest: *longest })
                .collect(),
            replicates: self.replicates,
            seed: self.seed,
            ..usual
        })
    }

    fn parts(&self, usual: Monomials) -> Result<Library, Failure> {
        let mut library = Library { monomials: usual, terms: self.terms.clone(), ..Library::default() };
        let mut chosen = None;
        for part in &self.library {
            let monomials = match part.as_str() {
                "tensor" => Monomials::Tensor,
                "total" => Monomials::TotalDegree,
                "separate" => Monomials::Separate,
                "constant" => {
                    library.constant = true;
                    continue;
                }
                "friction" => {
                    library.friction = true;
                    continue;
                }
                "trigonometric" => {
                    library.trigonometric = true;
                    continue;
                }
                "lagrangian" => {
                    library.lagrangian = true;
                    continue;
                }
                other => {
                    return Err(Failure::input(format!("`{other}` is no part of a library")).help(
                        "choose from `tensor`, `total`, `separate`, `constant`, `friction`, `trigonometric`, `lagrangian`",
                    ));
                }
            };
            if chosen.replace(monomials).is_some_and(|before| before != monomials) {
                return Err(Failure::input("library names two kinds of monomials")
                    .help("choose one of `tensor`, `total` and `separate`"));
            }
            library.monomials = monomials;
        }
        Ok(library)
    }
}

#[pyfunction]
#[pyo3(signature = (train, holdout, map, channels, wanted, progress))]
pub(crate) fn identify<'py>(
    py: Python<'py>,
    train: Vec<Source>,
    holdout: Vec<Source>,
    map: Vec<String>,
    channels: Vec<String>,
    wanted: Wanted,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Studied<'py>> {
    let options = raised(py, wanted.options())?;
    let sources = raised(py, Sources::new(train, holdout, map, &channels))?;
    let results = watched(py, progress, move |watch| {
        let names = wanted.states.iter().chain(&wanted.inputs).cloned();
        let Recordings { train, holdout } = sources.of_names(names).read()?;
        let found = greybox_identify::identify(&train, &holdout, &options, watch)?;
        watch.stage("writing the report");
        let told = Told { train: &train, holdout: &holdout, hold: options.hold };
        identification::Results::of(&found, &told)
    })?;
    let recordings = curves(py, &results.recordings)?;
    Ok((results.report_json, results.story, Some(results.report_html), results.model_toml, recordings))
}

#[pyfunction]
#[pyo3(signature = (model, train, holdout, map, channels, progress))]
pub(crate) fn calibrate<'py>(
    py: Python<'py>,
    model: &Model,
    train: Vec<Source>,
    holdout: Vec<Source>,
    map: Vec<String>,
    channels: Vec<String>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Studied<'py>> {
    let loaded = model.loaded();
    let sources = raised(py, Sources::new(train, holdout, map, &channels))?;
    let results = watched(py, progress, move |watch| {
        let Recordings { train, holdout } = fitting(sources, &loaded.model)?;
        calibration::has_free_parameter(&loaded)?;
        let found = greybox_diagnose::calibrate(&loaded.model, &train, &holdout, watch)
            .map_err(|e| Failure::diagnosis(&loaded.path, e))?;
        watch.stage("writing the report");
        calibration::Results::of(&found, &loaded, &train, &holdout)
    })?;
    let recordings = curves(py, &results.recordings)?;
    Ok((results.report_json, results.story, None, results.model_toml, recordings))
}

/// JSON, story, times, and header and values of each measured channel.
type Simulated<'py> = (String, String, Bound<'py, PyArray1<f64>>, Vec<(String, Bound<'py, PyArray1<f64>>)>);

#[pyfunction]
#[pyo3(signature = (model, recording, map, channels, progress))]
pub(crate) fn simulate<'py>(
    py: Python<'py>,
    model: &Model,
    recording: Source,
    map: Vec<String>,
    channels: Vec<String>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Simulated<'py>> {
    let loaded = model.loaded();
    let sources = raised(py, Sources::new(vec![recording], Vec::new(), map, &channels))?;
    let (simulated, time) = watched(py, progress, move |watch| {
        let Recordings { train, .. } = sources.of_model(&loaded.model).read()?;
        let recording = train.into_iter().next().ok_or_else(Failure::fault)?;
        let simulated = simulation::simulate(&loaded, &recording, &|what| watch.stage(what))?;
        Ok((simulated, recording.time))
    })?;
    let columns =
        simulated.columns.into_iter().map(|(header, values)| (header, PyArray1::from_vec(py, values)));
    let columns = columns.collect();
    Ok((simulated.json.to_string(), simulated.story, PyArray1::from_vec(py, time), columns))
}

#[pyfunction]
#[pyo3(signature = (recordings, model, inputs, map, channels))]
pub(crate) fn check(
    py: Python<'_>,
    recordings: Vec<Source>,
    model: Option<&Model>,
    inputs: Vec<String>,
    map: Vec<String>,
    channels: Vec<String>,
) -> PyResult<(String, String)> {
    let loaded = model.map(Model::loaded);
    let sources = raised(py, Sources::new(recordings, Vec::new(), map, &channels))?;
    watched(py, None, move |_| {
        let model = loaded.as_ref().map(|l| &l.model);
        let sources = match model {
            Some(model) => sources.of_model(model),
            None => sources,
        };
        let checked = checks::check(sources.without_folders()?.each()?, model, &inputs)?;
        Ok((checks::to_json(model, &checked).to_string(), checks::story(&checked)))
    })
}

/// Recordings and free runs as dicts of arrays; a run that there is not is left out.
fn curves<'py>(py: Python<'py>, recordings: &[page::Recording]) -> PyResult<Bound<'py, PyList>> {
    let told = PyList::empty(py);
    for recording in recordings {
        let channels = PyDict::new(py);
        for channel in &recording.channels {
            let series = PyDict::new(py);
            series.set_item("unit", &channel.unit)?;
            for (name, values) in [
                ("measured", &channel.measured),
                ("nominal", &channel.nominal),
                ("calibrated", &channel.calibrated),
                ("improved", &channel.improved),
            ] {
                if !values.is_empty() {
                    series.set_item(name, values.to_pyarray(py))?;
                }
            }
            channels.set_item(&channel.name, series)?;
        }
        let inputs = PyDict::new(py);
        for input in &recording.inputs {
            let series = PyDict::new(py);
            series.set_item("unit", &input.unit)?;
            series.set_item("values", input.values.to_pyarray(py))?;
            inputs.set_item(&input.name, series)?;
        }
        let one = PyDict::new(py);
        one.set_item("name", &recording.name)?;
        one.set_item(
            "role",
            match recording.role {
                page::Role::Train => "train",
                page::Role::Holdout => "holdout",
            },
        )?;
        one.set_item("t", recording.t.to_pyarray(py))?;
        one.set_item("channels", channels)?;
        one.set_item("inputs", inputs)?;
        told.append(one)?;
    }
    Ok(told)
}
