//! `greybox demo`: the whole story on an embedded recording.

use std::path::{Path, PathBuf};

use clap::Args;
use greybox_commands::diagnose::FILES;
use greybox_diagnose::Options;
use greybox_recording::parse_csv;

use crate::answer::Answer;
use crate::commands::diagnose::{diagnose, written};
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFolder;

const MODEL: &str = include_str!("../../demo/rotary_link.toml");
const TRAIN: &[u8] = include_bytes!("../../demo/rotary_link_train.csv");
const HOLDOUT: &[u8] = include_bytes!("../../demo/rotary_link_test.csv");
/// What the embedded files are.
const ABOUT: &str = include_str!("../../demo/about.txt");

/// Diagnose an embedded recording: the whole story in about two minutes
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox demo
  greybox demo --out demo

With --out, DIR receives the report, the improved model, and the embedded model and recordings, to try the
other commands on.")]
pub(crate) struct Arguments {
    /// Folder for the results; nothing is written without it
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let embedded: [(&str, &[u8]); 3] = [
        ("rotary_link.toml", MODEL.as_bytes()),
        ("rotary_link_train.csv", TRAIN),
        ("rotary_link_test.csv", HOLDOUT),
    ];
    let out = arguments.out.as_deref().map(OutputFolder::prepare).transpose()?;
    if let Some(folder) = &out {
        folder.spares_other(&embedded)?;
    }
    let loaded = loading::model_of(MODEL.to_owned(), Path::new("rotary_link.toml"))?;
    let train = [parse_csv(TRAIN, "rotary_link_train.csv")?];
    let holdout = [parse_csv(HOLDOUT, "rotary_link_test.csv")?];
    let results = diagnose(&loaded, &train, &holdout, &Options::default())?;
    let mut text = format!(
        "{ABOUT}\nThe model, rotary_link.toml:\n\n{}\nWhat greybox says:\n\n{}",
        indented(MODEL),
        results.story
    );
    match (&out, &arguments.out) {
        (Some(folder), Some(path)) => {
            folder.write(&[&results.files(), &embedded[..]].concat())?;
            text.push('\n');
            let [.., improved] = FILES;
            text.push_str(&written(path, improved));
        }
        _ => text
            .push_str("\nWith `--out DIR` the report, the improved model and the recordings are written.\n"),
    }
    Ok(Answer::new(text, results.json))
}

fn indented(text: &str) -> String {
    text.lines().map(|line| format!("  {line}").trim_end().to_owned() + "\n").collect()
}
