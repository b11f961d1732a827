//! `greybox mechanisms`: what a diagnosis can name.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;
use greybox_diagnose::Mechanism;
use serde_json::{Value, json};

use crate::answer::Answer;
use crate::failure::Failure;
use crate::loading;

/// A mechanism file to start from, with every key explained.
pub(crate) const EXAMPLE: &str = include_str!("../../demo/mechanism.toml");

/// List the mechanisms that a diagnosis can name, or print one to start from
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox mechanisms
  greybox mechanisms --example > mine/belt.toml
  greybox mechanisms --mechanisms mine

With --mechanisms, the files of the folder are checked and listed too.")]
pub(crate) struct Arguments {
    /// Folder of mechanisms of your own (*.toml)
    #[arg(long, value_name = "DIR", conflicts_with = "example")]
    mechanisms: Option<PathBuf>,

    /// Print a mechanism file to start from
    #[arg(long)]
    example: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Answer, Failure> {
    if arguments.example {
        return Ok(Answer::new(EXAMPLE.to_owned(), json!({ "example": EXAMPLE })));
    }
    let mut mechanisms = match &arguments.mechanisms {
        Some(folder) => loading::mechanisms(folder)?.library.mechanisms,
        None => greybox_diagnose::built_in().map_err(|e| Failure::internal(e.to_string()))?,
    };
    mechanisms.retain(|m| m.named && m.doubts.is_empty()); // never named, so nothing to list
    mechanisms.sort_by(|a, b| (&a.family, &a.kind).cmp(&(&b.family, &b.kind)));
    let json = json!({ "mechanisms": mechanisms.iter().map(for_machines).collect::<Vec<_>>() });
    Ok(Answer::new(in_words(&mechanisms), json))
}

fn for_machines(m: &Mechanism) -> Value {
    json!({
        "kind": m.kind,
        "family": m.family,
        "on": m.on.name(),
        "law": m.law.to_string(),
        "parameters": m.parameters().collect::<Vec<_>>(),
        "signature": m.about.signature,
    })
}

/// By family, each kind with its law and its signature.
fn in_words(mechanisms: &[Mechanism]) -> String {
    let mut text = String::new();
    let mut family = None;
    for m in mechanisms {
        if family != Some(&m.family) {
            family = Some(&m.family);
            let _ =
                writeln!(text, "{}{}", if text.is_empty() { "" } else { "\n" }, m.family.replace('_', " "));
        }
        let _ = writeln!(text, "  {} ({}): {}\n      {}", m.kind, m.on.name(), m.law, m.about.signature);
    }
    text
}
