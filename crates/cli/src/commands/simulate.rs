//! `greybox simulate`: a free run of the model on a recording's inputs.

use std::path::PathBuf;

use clap::Args;
use greybox_calibrate::Data;
use greybox_commands::simulate::simulate;
use greybox_recording::write_csv;
use serde_json::json;

use crate::answer::Answer;
use crate::channels::Channels;
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFile;
use crate::progress::Progress;

/// Simulate a model on the inputs of a recording, from the initial state estimated on its first quarter
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox simulate improved.toml run3.csv --out simulated.csv
  greybox simulate improved.toml run3.mat --map theta=sensor_3 --out simulated.csv

OUT.csv has the times of the recording and one column per measured channel, under the same names and in the
same units. Rows that the simulation does not reach (a piece too short to use, a simulation that diverges)
have empty cells.

With --json, `initial_si` holds the initial state of each piece.")]
pub(crate) struct Arguments {
    /// Model (TOML)
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// Recording whose inputs drive the model (CSV, MAT-file, HDF5, NumPy, MCAP or Parquet)
    #[arg(value_name = "INPUT.csv")]
    input: PathBuf,

    #[command(flatten)]
    channels: Channels,

    /// File to write
    #[arg(long, value_name = "OUT.csv")]
    out: PathBuf,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let loaded = loading::model(&arguments.model)?;
    let wanted = arguments.channels.wanted().of_model(&loaded.model);
    let recordings = loading::recordings(std::slice::from_ref(&arguments.input), &wanted)?;
    let [recording] = recordings.as_slice() else {
        return Err(Failure::internal("one recording was named, but not read"));
    };
    Data::new(&loaded.model, &recordings)?;
    let out = OutputFile::prepare(&arguments.out, &[&arguments.model, &arguments.input])?;

    let progress = Progress::open();
    let mut simulated = simulate(&loaded, recording, &|what| progress.stage(what))?;
    drop(progress);

    let columns: Vec<(&str, &[f64])> =
        simulated.columns.iter().map(|(header, values)| (header.as_str(), values.as_slice())).collect();
    let mut csv = Vec::new();
    write_csv(&mut csv, &recording.time, &columns)?;
    out.write(&csv)?;
    let place = arguments.out.display().to_string();
    let text = format!("{place}: {}", simulated.story);
    simulated.json["out"] = json!(place);
    Ok(Answer::new(text, simulated.json))
}
