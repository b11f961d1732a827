//! The book's page of commands and options beside what the command says of itself.
#![allow(missing_docs, clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

fn page() -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/commands.md")).unwrap()
}

fn help(command: &[&str]) -> String {
    let run = Command::new(env!("CARGO_BIN_EXE_greybox")).args(command).arg("--help").output().unwrap();
    assert!(run.status.success(), "{command:?}");
    String::from_utf8(run.stdout).unwrap()
}

/// The long options that a help lists, without `--help` itself.
fn options(help: &str) -> BTreeSet<String> {
    let listed = help.lines().map(str::trim_start).filter(|line| line.starts_with('-'));
    let long = listed.filter_map(|line| line.split_once("--").map(|(_, rest)| name(rest)));
    long.filter(|name| !name.is_empty() && name != "help").collect()
}

fn name(text: &str) -> String {
    let name: String = text.chars().take_while(|c| c.is_ascii_lowercase() || *c == '-').collect();
    name.trim_end_matches('-').to_owned()
}

fn commands() -> Vec<String> {
    let help = help(&[]);
    let listed = help.split_once("Commands:\n").unwrap().1.lines().take_while(|line| !line.is_empty());
    let names = listed.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names.map(|line| line.split_whitespace().next().unwrap().to_owned()).filter(|n| n != "help").collect()
}

#[test]
fn the_page_lists_every_command_and_option() {
    let (page, commands) = (page(), commands());
    assert!(commands.len() > 10 && commands.contains(&"diagnose".to_owned()), "{commands:?}");
    let common = options(&help(&[]));
    for command in commands {
        assert!(page.contains(&format!("| `{command}` |")), "{command} is not in the table of commands");
        let mut sections = page.split("\n## ").filter(|s| s.starts_with('`'));
        let section =
            sections.find(|s| s.lines().next().is_some_and(|l| l.contains(&format!("`{command}`"))));
        for option in options(&help(&[&command])).difference(&common) {
            let listed = section.is_some_and(|s| s.contains(&format!("--{option}")));
            assert!(listed, "`{command} --{option}` is not in docs/src/commands.md");
        }
    }
}

#[test]
fn the_page_lists_no_option_that_is_not_there() {
    let mut known = options(&help(&[]));
    known.insert("help".to_owned());
    for command in commands() {
        known.extend(options(&help(&[&command])));
    }
    for named in page().split("--").skip(1).map(name).filter(|n| !n.is_empty()) {
        assert!(known.contains(&named), "--{named} is no option");
    }
}
