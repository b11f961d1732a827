//! `greybox export`: a model in another language.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use greybox_export::{latex, latex_document, modelica, python};
use serde_json::json;

use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading;
use crate::output::OutputFile;

/// Write a model as a Python module, as LaTeX or in Modelica
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox export improved.toml --to python --out machine.py
  greybox export improved.toml --to latex --out machine.tex
  greybox export improved.toml --to latex --bare
  greybox export improved.toml --to modelica --out machine.mo

The Python module needs NumPy and SciPy, and simulates what `greybox simulate` simulates. In Modelica a sign is a
steep line, since there is no set-valued one. Values are SI in both; LaTeX keeps the units of the model.")]
pub(crate) struct Arguments {
    /// Model (TOML)
    #[arg(value_name = "MODEL.toml")]
    model: PathBuf,

    /// Language to write
    #[arg(long, value_name = "LANGUAGE")]
    to: Language,

    /// LaTeX: the equations alone, for `\input`, and no document around them
    #[arg(long)]
    bare: bool,

    /// File to write; standard output without it
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Language {
    /// A module on NumPy and SciPy that simulates the model
    Python,
    /// The equations and the table of parameters, as a document
    Latex,
    /// A Modelica model
    Modelica,
}

impl Language {
    fn name(self) -> &'static str {
        match self {
            Language::Python => "python",
            Language::Latex => "latex",
            Language::Modelica => "modelica",
        }
    }

    fn title(self) -> &'static str {
        match self {
            Language::Python => "Python",
            Language::Latex => "LaTeX",
            Language::Modelica => "Modelica",
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    if arguments.bare && arguments.to != Language::Latex {
        return Err(Failure::input("`--bare` is for LaTeX").help("leave it out, or write `--to latex`"));
    }
    let model = loading::model(&arguments.model)?.model;
    let text = match arguments.to {
        Language::Python => python(&model),
        Language::Modelica => modelica(&model),
        Language::Latex if arguments.bare => Ok(latex(&model)),
        Language::Latex => Ok(latex_document(&model)),
    }
    .map_err(|e| Failure::file(&arguments.model, e))?;
    let language = arguments.to.name();
    let Some(path) = &arguments.out else {
        let json = json!({ "language": language, "text": text });
        return Ok(Answer::new(text, json));
    };
    OutputFile::prepare(path, &[&arguments.model])?.write(text.as_bytes())?;
    let shown = path.display().to_string();
    let said = format!("{shown}: {} in {}\n", arguments.model.display(), arguments.to.title());
    Ok(Answer::new(said, json!({ "language": language, "out": shown })))
}
