//! The `greybox` command: reads files, calls the library, writes files and a plain-language summary.
//!
//! One file per subcommand in [`commands`]. A command returns its [`answer::Answer`] or one
//! [`failure::Failure`]; only this file and [`answer`] print.

mod answer;
mod arguments;
mod case;
mod channels;
mod commands;
mod failure;
mod log;
mod output;
mod progress;
mod study;

use std::ffi::OsString;
use std::process::ExitCode;

use answer::OutputFormat;
use arguments::Cli;
use failure::Failure;
use greybox_commands::loading;

fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let format =
        if arguments.iter().any(|a| a == "--json") { OutputFormat::Json } else { OutputFormat::Text };
    // The default hook has said on standard error where a panic was.
    let outcome =
        std::panic::catch_unwind(|| run(arguments, format)).unwrap_or_else(|_| Err(Failure::fault()));
    match outcome.and_then(|answer| answer.print(format)) {
        Ok(status) => status,
        Err(failure) => failure::print(&failure, format),
    }
}

fn run(arguments: Vec<OsString>, format: OutputFormat) -> Result<answer::Answer, Failure> {
    match Cli::read(arguments)? {
        Ok(cli) => {
            if cli.log {
                log::want();
            }
            cli.command.run(format)
        }
        Err(help) => Ok(help),
    }
}
