//! Controllers.

use std::path::PathBuf;

use greybox_commands::control::{self as design, Integral, ObserverKind, ObserverRequest, Request, Way};
use greybox_commands::{Failure, loading};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::error::raised;
use crate::input::{Model, Source};
use crate::watch::watched;

/// As the arguments of `greybox control`.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct Wanted {
    method: String,
    input: Option<String>,
    track: Option<String>,
    to: f64,
    feed_forward: String,
    size: Vec<(String, f64)>,
    input_size: f64,
    limit: Option<f64>,
    dt: f64,
    hold: f64,
    degree: u8,
    bounded: bool,
    #[pyo3(item("lambda_"))]
    lambda: f64,
    rate: f64,
    eta: Option<f64>,
    ignore_time_terms: bool,
    compensate_friction: bool,
    feedback: String,
    observer: String,
    noise: Vec<(String, f64)>,
    resolution: Vec<(String, f64)>,
    disturbance: Option<f64>,
    bandwidth: Option<f64>,
    integral: bool,
    integral_at_rest: bool,
    delay: f64,
    members: usize,
    seed: u64,
}

impl Wanted {
    /// The first argument that is given and that an observer alone has.
    fn of_observer(&self) -> Option<&'static str> {
        let given = [
            ("noise", !self.noise.is_empty()),
            ("resolution", !self.resolution.is_empty()),
            ("disturbance", self.disturbance.is_some()),
            ("bandwidth", self.bandwidth.is_some()),
            ("integral", !self.integral),
            ("integral_at_rest", self.integral_at_rest),
        ];
        given.into_iter().find(|(_, given)| *given).map(|(name, _)| name)
    }

    /// The observer between the sensors and the law, where the law is not given the full state.
    fn observer(&self) -> Result<Option<ObserverRequest>, Failure> {
        let kind = match self.observer.as_str() {
            "kalman" => ObserverKind::Kalman,
            "eso" => ObserverKind::Eso,
            other => {
                return Err(
                    Failure::input(format!("`{other}` is no observer")).help("choose `kalman` or `eso`")
                );
            }
        };
        match self.feedback.as_str() {
            "state" => match self.of_observer() {
                None => Ok(None),
                Some(name) => Err(Failure::input(format!(
                    "`{name}` belongs to an observer, and the law is given the full state"
                ))
                .help("add `feedback=\"output\"`")),
            },
            "output" => Ok(Some(ObserverRequest {
                kind,
                noise: self.noise.clone(),
                resolution: self.resolution.clone(),
                disturbance: self.disturbance,
                bandwidth: self.bandwidth,
                integral: match (self.integral, self.integral_at_rest) {
                    (false, false) => Integral::Off,
                    (true, false) => Integral::Disturbance,
                    (true, true) => Integral::AtRest { time: None },
                    (false, true) => {
                        return Err(Failure::input(
                            "`integral_at_rest` is an integral action, and `integral` is false",
                        )
                        .help("leave out one of them"));
                    }
                },
            })),
            other => Err(Failure::input(format!("`{other}` is nothing to feed back"))
                .help("choose `state` or `output`")),
        }
    }

    fn request(self) -> Result<Request, Failure> {
        let observer = self.observer()?;
        let static_feed_forward = match self.feed_forward.as_str() {
            "static" => true,
            "dynamic" => false,
            other => {
                return Err(Failure::input(format!("`{other}` is no feed-forward"))
                    .help("choose `static` or `dynamic`"));
            }
        };
        let method = match self.method.as_str() {
            "lqr" => Way::Lqr,
            "hjb" => Way::Hjb,
            "smc" => Way::Smc,
            other => {
                return Err(
                    Failure::input(format!("`{other}` is no method")).help("choose `lqr`, `hjb` or `smc`")
                );
            }
        };
        if let Some((name, value)) = self.size.iter().find(|(_, v)| !(*v > 0.0 && v.is_finite())) {
            return Err(Failure::input(format!("{value} is no size of `{name}`"))
                .help("give a positive number, such as `size={\"theta\": 0.5}`"));
        }
        Ok(Request {
            method,
            input: self.input,
            track: self.track,
            to: self.to,
            trajectory: None,
            static_feed_forward,
            sizes: self.size,
            input_size: self.input_size,
            limit: self.limit,
            dt: self.dt,
            hold: self.hold,
            degree: self.degree,
            bounded: self.bounded,
            lambda: self.lambda,
            rate: self.rate,
            eta: self.eta,
            ignore_time_terms: self.ignore_time_terms,
            compensate_friction: self.compensate_friction,
            observer,
            delay: self.delay,
            members: self.members,
            seed: self.seed,
        })
    }
}

/// An array of Python.
type Array<'py> = Bound<'py, PyArray1<f64>>;

/// JSON, story, files, and the loop: time, set point, command, states.
type Controlled<'py> = (
    String,
    String,
    Vec<(&'static str, Bound<'py, PyBytes>)>,
    (Array<'py>, Array<'py>, Array<'py>, Vec<(String, Array<'py>)>),
);

/// `report` is the report that the model is from: what errors call it, and its text; `reference` the trajectory.
#[pyfunction]
#[pyo3(signature = (model, wanted, reference, report, progress))]
pub(crate) fn control<'py>(
    py: Python<'py>,
    model: &Model,
    wanted: Wanted,
    reference: Option<Source>,
    report: Option<(PathBuf, String)>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Controlled<'py>> {
    let loaded = model.loaded();
    let track = wanted.track.clone();
    let mut request = raised(py, wanted.request())?;
    if let Some(reference) = reference {
        let channel = design::channel(&loaded.model, track.as_deref()).map(|c| vec![c]);
        let recording = raised(py, reference.read(&loading::Wanted::default().of_names(channel)))?;
        let path = PathBuf::from(&recording.name);
        request.trajectory =
            Some(raised(py, design::trajectory(&loaded, track.as_deref(), &recording, &path))?);
    }
    let results = watched(py, progress, move |watch| {
        let report = report.as_ref().map(|(path, text)| (path.as_path(), text.as_str()));
        design::control(&loaded, &request, report, &|what| watch.stage(what))
    })?;
    let files = results.files().into_iter().map(|(name, bytes)| (name, PyBytes::new(py, bytes))).collect();
    let run = results.run;
    let array = |values: Vec<f64>| PyArray1::from_vec(py, values);
    let states = run.states.into_iter().zip(run.x).map(|(name, x)| (name, array(x))).collect();
    let told = (array(run.t), array(run.r), array(run.u), states);
    Ok((format!("{:#}\n", results.json), results.story, files, told))
}
