//! `greybox completions` and `greybox man`: what a packager installs beside the command.

use clap::Args;
use clap_complete::Shell;
use serde_json::json;

use crate::answer::Answer;
use crate::failure::Failure;

/// Print the completions for a shell
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  greybox completions bash > ~/.local/share/bash-completion/completions/greybox
  greybox completions zsh > \"${fpath[1]}/_greybox\"
  greybox completions fish > ~/.config/fish/completions/greybox.fish")]
pub(crate) struct Completions {
    /// Shell to complete in
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

/// Print the manual page
#[derive(Debug, Args)]
#[command(after_help = "Example:
  greybox man > ~/.local/share/man/man1/greybox.1")]
pub(crate) struct Man {}

/// The script for a shell; `command` is the whole command line.
pub(crate) fn completions(arguments: &Completions, mut command: clap::Command) -> Result<Answer, Failure> {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut command, "greybox", &mut script);
    let text = text(script)?;
    let json = json!({ "shell": arguments.shell.to_string(), "text": text });
    Ok(Answer::new(text, json))
}

/// One page for the command and all its subcommands.
pub(crate) fn man(mut command: clap::Command) -> Result<Answer, Failure> {
    command.build();
    let mut page = Vec::new();
    let render = |command: clap::Command, page: &mut Vec<u8>| {
        clap_mangen::Man::new(command).render(page).map_err(|e| Failure::internal(e.to_string()))
    };
    render(command.clone(), &mut page)?;
    for subcommand in command.get_subcommands().filter(|s| !s.is_hide_set()) {
        let mut one = Vec::new();
        let man = clap_mangen::Man::new(subcommand.clone());
        let rendered = man
            .render_description_section(&mut one)
            .and_then(|()| man.render_synopsis_section(&mut one))
            .and_then(|()| man.render_options_section(&mut one))
            .and_then(|()| man.render_extra_section(&mut one));
        rendered.map_err(|e| Failure::internal(e.to_string()))?;
        let sections = text(one)?.replace(".SH ", ".SS ");
        page.extend(format!(".SH GREYBOX {}\n{sections}", subcommand.get_name().to_uppercase()).into_bytes());
    }
    let text = text(page)?;
    Ok(Answer::new(text.clone(), json!({ "text": text })))
}

fn text(bytes: Vec<u8>) -> Result<String, Failure> {
    String::from_utf8(bytes).map_err(|e| Failure::internal(e.to_string()))
}
