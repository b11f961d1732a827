//! Rows of signals, of the candidates' score test and of a diagnosis from beginning to end.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;
use greybox_algebraic::{Column, Hold, Kernel};
use greybox_calibrate::{Data, Limits, Point, Setup, free_parameters};
use greybox_diagnose::candidate::candidates;
use greybox_diagnose::place::places;
use greybox_diagnose::screen::screen;
use greybox_diagnose::{Options, Quiet, built_in, diagnose};
use greybox_model::Model;
use greybox_recording::{Recording, read_csv, smooth};

use super::case::{Against, Answer, Case, Row};
use super::sparse::Record;
use crate::root;

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    let row = |name, what, unit, make| Row { name, what, unit, against: Against::Peers(&[]), make };
    vec![
        row("signals", "windows of 1 s on 40 000 samples, one every 20, 3 columns", "record", signals),
        row("smoothing", "smoothing of 40 000 samples with two derivatives", "record", smoothing),
        row("screening", "score test of all mechanisms on the demo's recording", "candidate", screening),
        row("diagnosis", "greybox demo: the whole diagnosis", "diagnosis", diagnosis),
    ]
}

fn signals() -> Result<Case> {
    let record = Record::new(1)?;
    let kernel = Kernel::new(2, 2, 1000, 1e-3)?;
    Ok(Case::alone(1.0, move || {
        let column = |signal, order| Column { signal, order, hold: Hold::Smooth };
        let columns = [column(&record.x[..], 2), column(&record.x[..], 1), column(&record.force[..], 0)];
        let rows = greybox_algebraic::rows(&kernel, &columns, 20)?;
        Ok(Answer::from([("first".to_owned(), rows.columns.iter().map(|c| c[0]).collect())]))
    }))
}

fn smoothing() -> Result<Case> {
    let record = Record::new(1)?;
    Ok(Case::alone(1.0, move || {
        let smoothed = smooth::savitzky_golay(&record.x, 1e-3, 101, 5);
        Ok(Answer::from([("d1".to_owned(), smoothed.d1)]))
    }))
}

fn demo() -> PathBuf {
    root().join("crates").join("cli").join("demo")
}

fn model() -> Result<Model> {
    let text = std::fs::read_to_string(demo().join("rotary_link.toml"))?;
    Ok(Model::from_toml(&text, "rotary_link.toml")?)
}

fn recording(name: &str) -> Result<Recording> {
    Ok(read_csv(demo().join(name))?)
}

fn screening() -> Result<Case> {
    let (model, library) = (model()?, built_in()?);
    let data = Arc::new(Data::new(&model, &[recording("rotary_link_train.csv")?])?);
    let setup = Setup::new(&model, data, free_parameters(&model))?;
    let level = setup.windows(200, 20_000);
    let scale = setup.data.spread.clone();
    let point = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
    let fit = setup.fit(&level, &scale, &[point], Limits::default());
    let candidates = candidates(&model, &library, &places(&model));
    Ok(Case::alone(candidates.len() as f64, move || {
        let scored = screen(&setup, &library, &candidates, &level, &scale, &fit.point);
        Ok(Answer::from([("gains".to_owned(), scored.iter().map(|s| s.gain).collect())]))
    }))
}

fn diagnosis() -> Result<Case> {
    let model = model()?;
    let train = [recording("rotary_link_train.csv")?];
    let test = [recording("rotary_link_test.csv")?];
    Ok(Case::alone(1.0, move || {
        let found = diagnose(&model, &train, &test, &Options::default(), &Quiet)?;
        Ok(Answer::from([("mechanisms".to_owned(), vec![found.mechanisms.len() as f64])]))
    }))
}
