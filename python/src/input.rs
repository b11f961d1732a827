//! Recordings and models from Python.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use greybox_commands::Failure;
use greybox_commands::loading::{self, LoadedModel, Wanted};
use greybox_model::{Hold, Unit, WriteOptions, nearest};
use greybox_recording::{Channel, Clock, Rename, RenameError, Series};
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::raised;

/// A recording in memory.
#[pyclass(frozen, module = "greybox._native")]
pub(crate) struct Recording(pub(crate) greybox_recording::Recording);

/// Header name, unit and values of a channel.
type Column<'py> = (String, Option<String>, PyReadonlyArray1<'py, f64>);

/// The same with whether each value is held until the next one.
type Signal<'py> = (String, Option<String>, bool, PyReadonlyArray1<'py, f64>);

/// The same on its way out.
type Told<'a, 'py> = (&'a str, Option<&'a str>, Bound<'py, PyArray1<f64>>);

#[pymethods]
impl Recording {
    /// From columns: name, times in s, channels.
    #[new]
    fn new(
        py: Python<'_>,
        name: &str,
        time: PyReadonlyArray1<'_, f64>,
        channels: Vec<Column<'_>>,
    ) -> PyResult<Recording> {
        let values = |array: &PyReadonlyArray1<'_, f64>| array.as_array().to_vec();
        let channels = channels
            .iter()
            .map(|(name, unit, array)| Channel {
                name: name.clone(),
                unit: unit.clone(),
                values: values(array),
            })
            .collect();
        let made = greybox_recording::Recording::from_columns(name, values(&time), channels);
        raised(py, made.map(Recording).map_err(Failure::from))
    }

    /// From tables with clocks of their own: times in s, and channels. A clock is called as its first channel.
    #[staticmethod]
    fn from_clocks(
        py: Python<'_>,
        name: &str,
        clocks: Vec<(PyReadonlyArray1<'_, f64>, Vec<Signal<'_>>)>,
    ) -> PyResult<Recording> {
        let values = |array: &PyReadonlyArray1<'_, f64>| array.as_array().to_vec();
        let series = |(name, unit, held, array): &Signal<'_>| Series {
            name: name.clone(),
            unit: unit.clone(),
            held: *held,
            values: values(array),
        };
        let clocks = clocks.iter().map(|(time, signals)| Clock {
            name: signals.first().map(|(name, ..)| name.clone()).unwrap_or_default(),
            time: values(time),
            resolution: 0.0,
            series: signals.iter().map(series).collect(),
        });
        let made = greybox_recording::Recording::from_clocks(name, clocks.collect());
        raised(py, made.map(Recording).map_err(Failure::from))
    }

    /// What is in a file.
    #[staticmethod]
    fn read(py: Python<'_>, path: PathBuf) -> PyResult<Recording> {
        let read = py.detach(|| loading::recordings(&[path], &Wanted::default()));
        raised(py, read.and_then(only)).map(Recording)
    }

    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Times, s.
    #[getter]
    fn t<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.0.time)
    }

    /// Name, unit and values of each channel.
    #[getter]
    fn channels<'py>(&self, py: Python<'py>) -> Vec<Told<'_, 'py>> {
        self.0
            .channels
            .iter()
            .map(|c| (c.name.as_str(), c.unit.as_deref(), PyArray1::from_slice(py, &c.values)))
            .collect()
    }
}

fn only(read: Vec<greybox_recording::Recording>) -> Result<greybox_recording::Recording, Failure> {
    read.into_iter().next().ok_or_else(|| Failure::internal("a recording was named, but not read"))
}

/// A recording as Python hands it on.
#[derive(FromPyObject)]
pub(crate) enum Source {
    Memory(Py<Recording>),
    File(PathBuf),
}

impl Source {
    /// # Errors
    /// Bad input: a file that is no recording.
    pub(crate) fn read(self, wanted: &Wanted) -> Result<greybox_recording::Recording, Failure> {
        match self {
            Source::Memory(recording) => Ok(recording.get().0.clone()),
            Source::File(path) => loading::recordings(&[path], wanted).and_then(only),
        }
    }
}

/// The recordings to learn from and those held out, not read yet.
pub(crate) struct Sources {
    train: Vec<Place>,
    holdout: Vec<Place>,
    wanted: Wanted,
}

enum Place {
    Memory(greybox_recording::Recording),
    File(PathBuf),
}

impl Sources {
    /// # Errors
    /// Bad input: a renaming that is none.
    pub(crate) fn new(
        train: Vec<Source>,
        holdout: Vec<Source>,
        map: Vec<String>,
        channels: &[String],
    ) -> Result<Sources, Failure> {
        let map = map.iter().map(|text| rename(text)).collect::<Result<Vec<_>, _>>()?;
        let place = |source| match source {
            Source::Memory(recording) => Place::Memory(recording.get().0.clone()),
            Source::File(path) => Place::File(path),
        };
        Ok(Sources {
            train: train.into_iter().map(place).collect(),
            holdout: holdout.into_iter().map(place).collect(),
            wanted: Wanted::new(&map, channels),
        })
    }

    /// Of a file with several clocks only what the model names.
    pub(crate) fn of_model(self, model: &greybox_model::Model) -> Sources {
        Sources { wanted: self.wanted.of_model(model), ..self }
    }

    /// Of a file with several clocks only these channels.
    pub(crate) fn of_names(self, names: impl Iterator<Item = String>) -> Sources {
        Sources { wanted: self.wanted.of_names(names.map(|name| vec![name])), ..self }
    }

    /// The same with the recordings of every folder in its place.
    ///
    /// # Errors
    /// As [`loading::recordings_of`].
    pub(crate) fn without_folders(self) -> Result<Sources, Failure> {
        let spread = |places: Vec<Place>| -> Result<Vec<Place>, Failure> {
            let mut files = Vec::with_capacity(places.len());
            for place in places {
                match place {
                    Place::File(path) => {
                        files.extend(loading::without_folders(&[path])?.into_iter().map(Place::File));
                    }
                    memory @ Place::Memory(_) => files.push(memory),
                }
            }
            Ok(files)
        };
        Ok(Sources { train: spread(self.train)?, holdout: spread(self.holdout)?, wanted: self.wanted })
    }

    /// Reads the files; recordings to learn from, then those held out.
    ///
    /// # Errors
    /// As [`loading::recordings`], and two recordings of one name.
    pub(crate) fn read(self) -> Result<Recordings, Failure> {
        let count = self.train.len();
        let mut train = self.each()?.into_iter().collect::<Result<Vec<_>, _>>()?;
        let holdout = train.split_off(count);
        Ok(Recordings { train, holdout })
    }

    /// Reads the files, each of which may fail on its own; recordings to learn from, then those held out.
    ///
    /// # Errors
    /// Bad input: a file named twice, or two recordings of one name.
    pub(crate) fn each(self) -> Result<Vec<Result<greybox_recording::Recording, Failure>>, Failure> {
        let all: Vec<Place> = self.train.into_iter().chain(self.holdout).collect();
        let paths: Vec<PathBuf> = all
            .iter()
            .filter_map(|place| match place {
                Place::File(path) => Some(path.clone()),
                Place::Memory(_) => None,
            })
            .collect();
        let mut files = loading::each_recording(&paths, &self.wanted)?;
        let mut names = HashSet::new();
        let mut read = Vec::with_capacity(all.len());
        for place in all {
            let one = match place {
                Place::Memory(mut recording) => self.wanted.apply(&mut recording).map(|()| recording),
                Place::File(_) => files
                    .next()
                    .unwrap_or_else(|| Err(Failure::internal("a recording was named, but not read"))),
            };
            if let Ok(recording) = &one
                && !names.insert(recording.name.clone())
            {
                return Err(Failure::input(format!("two recordings are called {}", recording.name))
                    .help("give each a name of its own: `greybox.Recording(data, name=…)`"));
            }
            read.push(one);
        }
        Ok(read)
    }
}

/// What [`Sources`] hold.
pub(crate) struct Recordings {
    pub(crate) train: Vec<greybox_recording::Recording>,
    pub(crate) holdout: Vec<greybox_recording::Recording>,
}

/// As `--map` of the command: a symbol that is not built in may be declared by the model.
pub(crate) fn rename(text: &str) -> Result<Rename, Failure> {
    let rename: Rename = text.parse().map_err(|e: RenameError| Failure::input(e.to_string()))?;
    match rename.unit.as_deref().map(Unit::parse) {
        Some(Err(error)) if error.unknown.is_none() && rename.states_unit() => {
            Err(Failure::input(error.to_string()))
        }
        _ => Ok(rename),
    }
}

/// A model in the model language.
#[pyclass(frozen, module = "greybox._native")]
pub(crate) struct Model(LoadedModel);

impl Model {
    pub(crate) fn loaded(&self) -> LoadedModel {
        LoadedModel {
            model: self.0.model.clone(),
            text: self.0.text.clone(),
            path: self.0.path.clone(),
            file: self.0.file.clone(),
        }
    }
}

#[pymethods]
impl Model {
    /// From its text; `file` is what errors and reports call it.
    #[new]
    fn new(py: Python<'_>, text: String, file: &str) -> PyResult<Model> {
        raised(py, loading::model_of(text, Path::new(file)).map(Model))
    }

    /// From a file.
    #[staticmethod]
    fn read(py: Python<'_>, path: PathBuf) -> PyResult<Model> {
        raised(py, loading::model(&path).map(Model))
    }

    #[getter]
    fn name(&self) -> &str {
        &self.0.model.name
    }

    #[getter]
    fn file(&self) -> &str {
        &self.0.file
    }

    /// Where it was read, as errors name it.
    #[getter]
    fn path(&self) -> &Path {
        &self.0.path
    }

    #[getter]
    fn text(&self) -> &str {
        &self.0.text
    }

    #[getter]
    fn inputs(&self) -> Vec<&str> {
        self.0.model.inputs.iter().map(|i| i.name.as_str()).collect()
    }

    #[getter]
    fn states(&self) -> Vec<&str> {
        self.0.model.states.iter().map(|s| s.name.as_str()).collect()
    }

    #[getter]
    fn equations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let told = PyDict::new(py);
        for equation in &self.0.model.equations {
            told.set_item(&equation.name, equation.to_string())?;
        }
        Ok(told)
    }

    /// Value, unit, standard deviation and `fixed` of each parameter, in the units of the file.
    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for p in &self.0.model.parameters {
            let value = p.unit.as_ref().map_or(p.value, |u| u.from_si(p.value));
            let std = p.std.map(|s| p.unit.as_ref().map_or(s, |u| u.difference_from_si(s)));
            let told = PyDict::new(py);
            told.set_item("value", value)?;
            told.set_item("unit", p.unit.as_ref().map(|u| u.text.as_str()))?;
            told.set_item("std", std)?;
            told.set_item("fixed", p.fixed)?;
            all.set_item(&p.name, told)?;
        }
        Ok(all)
    }

    /// The model with other values of parameters, in the units of the file.
    fn with_parameters(&self, py: Python<'_>, values: Vec<(String, f64)>) -> PyResult<Model> {
        raised(py, self.changed(&values))
    }
}

impl Model {
    fn changed(&self, values: &[(String, f64)]) -> Result<Model, Failure> {
        let mut model = self.0.model.clone();
        for (name, value) in values {
            let Some(index) = model.parameter(name) else {
                let known = model.parameters.iter().map(|p| p.name.as_str());
                let failure = Failure::file(&self.0.path, format!("there is no parameter `{name}`"));
                return Err(match nearest(name, known) {
                    Some(near) => failure.help(format!("did you mean `{near}`?")),
                    None => failure.help("name one of the model's [parameters]"),
                });
            };
            if !value.is_finite() {
                return Err(Failure::file(&self.0.path, format!("`{name}` cannot be {value}"))
                    .help("give a finite number"));
            }
            let parameter = &mut model.parameters[index];
            parameter.value = parameter.unit.as_ref().map_or(*value, |u| u.to_si(*value));
        }
        let text = model.to_toml(&WriteOptions { original: Some(&self.0.text), ..Default::default() });
        loading::model_of(text, &self.0.path).map(Model)
    }
}

/// A hold by its name.
///
/// # Errors
/// Bad input: no such hold.
pub(crate) fn hold(name: &str) -> Result<Hold, Failure> {
    [Hold::Zero, Hold::Linear, Hold::BandLimited].into_iter().find(|hold| hold.name() == name).ok_or_else(
        || Failure::input(format!("`{name}` is no hold")).help("choose `zero`, `linear` or `band_limited`"),
    )
}
