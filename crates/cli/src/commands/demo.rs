//! `greybox demo`: the whole story on embedded recordings.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use greybox_commands::diagnose::FILES;
use greybox_diagnose::Options;
use greybox_recording::parse_csv;

use crate::answer::Answer;
use crate::commands::diagnose::{diagnose, written};
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFolder;

/// A machine whose model and recordings come with the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Machine {
    /// A cart on a spring with dry friction: a few seconds
    Cart,
    /// The flexible link of the thesis: dry friction, and forces that no name fits; about two minutes
    Link,
}

/// Name and content of an embedded file.
type File = (&'static str, &'static str);

/// The embedded files of a machine.
struct Embedded {
    about: &'static str,
    model: File,
    train: File,
    holdout: File,
}

impl Machine {
    fn embedded(self) -> Embedded {
        match self {
            Machine::Cart => Embedded {
                about: include_str!("../../demo/cart.txt"),
                model: ("cart.toml", include_str!("../../demo/cart.toml")),
                train: ("cart_train.csv", include_str!("../../demo/cart_train.csv")),
                holdout: ("cart_test.csv", include_str!("../../demo/cart_test.csv")),
            },
            Machine::Link => Embedded {
                about: include_str!("../../demo/rotary_link.txt"),
                model: ("rotary_link.toml", include_str!("../../demo/rotary_link.toml")),
                train: ("rotary_link_train.csv", include_str!("../../demo/rotary_link_train.csv")),
                holdout: ("rotary_link_test.csv", include_str!("../../demo/rotary_link_test.csv")),
            },
        }
    }
}

/// Diagnose embedded recordings: the whole story in a few seconds
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox demo
  greybox demo --out demo
  greybox demo link --out link

With --out, DIR receives the report, the improved model, and the embedded model and recordings, to try the
other commands on.")]
pub(crate) struct Arguments {
    /// Machine whose recordings are diagnosed
    #[arg(value_enum, value_name = "MACHINE", default_value_t = Machine::Cart)]
    machine: Machine,

    /// Folder for the results; nothing is written without it
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let Embedded { about, model, train, holdout } = arguments.machine.embedded();
    let embedded = [model, train, holdout].map(|(name, content)| (name, content.as_bytes()));
    let out = arguments.out.as_deref().map(OutputFolder::prepare).transpose()?;
    if let Some(folder) = &out {
        folder.spares_other(&embedded)?;
    }
    let loaded = loading::model_of(model.1.to_owned(), Path::new(model.0))?;
    let [train, holdout] = [train, holdout].map(|(name, content)| parse_csv(content.as_bytes(), name));
    let results = diagnose(&loaded, &[train?], &[holdout?], &Options::default())?;
    let mut text = format!(
        "{about}\nThe model, {}:\n\n{}\nWhat greybox says:\n\n{}",
        model.0,
        indented(model.1),
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
