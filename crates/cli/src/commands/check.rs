//! `greybox check`: are these recordings good enough, and do they fit the model?

use std::path::PathBuf;

use clap::Args;
use greybox_commands::check;

use crate::answer::Answer;
use crate::channels::Channels;
use crate::failure::Failure;
use crate::loading;

/// Check the health of recordings: sampling, gaps, clipping, quantisation, outliers, excitation, delay, clocks
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox check run1.csv run2.csv
  greybox check recordings --model link.toml --map \"theta=sensor_3 [deg]\"
  greybox check run1.csv --inputs v
  greybox check log.mcap --channels \"/joint_states.position[elbow]\" --channels /cmd.data
  greybox check run1.csv --model link.toml --json

A folder stands for all recordings in it and in its folders (*.csv, *.mat, *.h5, *.hdf5, *.npz, *.npy, *.mcap,
*.parquet); each episode of a Parquet file is one, such as data.parquet#3. A recording that cannot be read stops no other; the exit status is 2 then.")]
pub(crate) struct Arguments {
    /// Recordings, or folders of them (CSV: first column `t` in seconds, header cells `name` or `name [unit]`;
    /// MAT-file; HDF5; NumPy; MCAP; Parquet)
    #[arg(value_name = "RECORDING.csv", required = true)]
    recordings: Vec<PathBuf>,

    /// Model whose inputs and measurements the channels must feed
    #[arg(long, value_name = "MODEL.toml", conflicts_with = "inputs")]
    model: Option<PathBuf>,

    /// Channels that drive the system; the others are taken as its response
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    inputs: Vec<String>,

    #[command(flatten)]
    channels: Channels,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let loaded = arguments.model.as_deref().map(loading::model).transpose()?;
    let paths = loading::without_folders(&arguments.recordings)?;
    let model = loaded.as_ref().map(|l| &l.model);
    let wanted = arguments.channels.wanted();
    let wanted = match model {
        Some(model) => wanted.of_model(model),
        None => wanted,
    };
    let recordings = loading::each_recording(&paths, &wanted)?;
    let checked = check::check(recordings, model, &arguments.inputs)?;
    let answer = Answer::new(check::story(&checked), check::to_json(model, &checked));
    Ok(answer.without(checked.failures))
}
