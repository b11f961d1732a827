//! Rows of signals, of the candidates' score test and of a diagnosis from beginning to end.

use std::sync::Arc;

use anyhow::Result;
use greybox_algebraic::{Column, Hold, Kernel};
use greybox_calibrate::{Data, FitPoint, Limits, Point, Setup, free_parameters};
use greybox_diagnose::built_in;
use greybox_diagnose::candidate::candidates;
use greybox_diagnose::place::places;
use greybox_diagnose::screen::screen;
use greybox_recording::smooth;

use super::case::{Against, Answer, Case, Row};
use super::sparse::Record;
use greybox_dev::demo::Demo;

/// The rows.
pub(crate) fn rows() -> Vec<Row> {
    let row = |name, what, unit, make| Row::new(name, what, unit, Against::NOTHING, make);
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

fn screening() -> Result<Case> {
    let (Demo { model, train, .. }, mut library) = (Demo::read()?, built_in()?);
    library.retain(|m| m.named);
    let data = Arc::new(Data::new(&model, &train)?);
    let setup = Setup::new(&model, data, free_parameters(&model))?;
    let level = setup.windows(200, 20_000);
    let scale = setup.data.spread.clone();
    let point = Point { parameters: setup.values(), starts: setup.starts(&level, &setup.values()) };
    let fit = setup.fit(&level, &scale, &[point], Limits::default());
    let candidates = candidates(&model, &library, &places(&model));
    Ok(Case::alone(candidates.len() as f64, move || {
        let at = FitPoint { setup: &setup, level: &level, scale: &scale, point: &fit.point };
        let scored = screen(at, &library, &candidates);
        Ok(Answer::from([("gains".to_owned(), scored.iter().map(|s| s.gain).collect())]))
    }))
}

fn diagnosis() -> Result<Case> {
    let demo = Demo::read()?;
    Ok(Case::alone(1.0, move || {
        let found = demo.diagnose()?;
        Ok(Answer::from([("mechanisms".to_owned(), vec![found.mechanisms.len() as f64])]))
    }))
}
