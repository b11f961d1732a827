//! `greybox new`: a model to start from.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;
use greybox_model::Model;
use serde_json::{Value, json};

use crate::answer::Answer;
use crate::failure::Failure;
use crate::output::OutputFile;

/// Name and text of the templates.
const TEMPLATES: [(&str, &str); 7] = [
    ("servo", include_str!("../../templates/servo.toml")),
    ("two_mass_drive", include_str!("../../templates/two_mass_drive.toml")),
    ("pendulum", include_str!("../../templates/pendulum.toml")),
    ("flexible_link", include_str!("../../templates/flexible_link.toml")),
    ("quarter_car", include_str!("../../templates/quarter_car.toml")),
    ("oscillator", include_str!("../../templates/oscillator.toml")),
    ("linear_axis", include_str!("../../templates/linear_axis.toml")),
];

/// Write a commented model to start from: a servo, a linear axis, a pendulum, …
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox new --list
  greybox new servo --out servo.toml
  greybox new pendulum > pendulum.toml

Each template says where to look up its parameters, and which book has its equations. A file that is there
already is not replaced.")]
pub(crate) struct Arguments {
    /// Name of a template
    #[arg(value_name = "TEMPLATE", required_unless_present = "list")]
    template: Option<String>,

    /// List the templates
    #[arg(long, conflicts_with_all = ["template", "out"])]
    list: bool,

    /// File to write; standard output without it
    #[arg(long, value_name = "MODEL.toml")]
    out: Option<PathBuf>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    let Some(wanted) = &arguments.template else { return list() };
    let Some((name, text)) = TEMPLATES.into_iter().find(|(name, _)| name == wanted) else {
        let names: Vec<&str> = TEMPLATES.iter().map(|(name, _)| *name).collect();
        return Err(Failure::input(format!("there is no template called `{wanted}`"))
            .help(format!("name one of {}", names.join(", "))));
    };
    let Some(path) = &arguments.out else {
        return Ok(Answer::new(text.to_owned(), json!({ "template": name, "text": text })));
    };
    if path.exists() {
        return Err(Failure::file(path, "this file is there already").help("name another after `--out`"));
    }
    OutputFile::prepare(path, &[])?.write(text.as_bytes())?;
    let shown = path.display().to_string();
    let said = format!(
        "{shown}: {}\n\nPut your machine's numbers under [parameters], then:\n  greybox check run1.csv --model {shown}\n  \
         greybox diagnose {shown} run1.csv --out result\n",
        title(name, text)?
    );
    Ok(Answer::new(said, json!({ "template": name, "out": shown })))
}

fn list() -> Result<Answer, Failure> {
    let mut said = String::new();
    let mut templates: Vec<Value> = Vec::new();
    for (name, text) in TEMPLATES {
        let model = load(name, text)?;
        let _ = writeln!(said, "{name}: {}", model.name);
        let equations: Vec<String> = model.equations.iter().map(ToString::to_string).collect();
        for equation in &equations {
            let _ = writeln!(said, "    {equation}");
        }
        templates.push(json!({ "name": name, "title": model.name, "equations": equations }));
    }
    Ok(Answer::new(said, json!({ "templates": templates })))
}

fn title(name: &str, text: &str) -> Result<String, Failure> {
    Ok(load(name, text)?.name)
}

fn load(name: &str, text: &str) -> Result<Model, Failure> {
    Model::from_toml(text, name).map_err(|e| Failure::internal(e.to_string()))
}
