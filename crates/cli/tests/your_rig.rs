//! The book's page *Your own rig*: its script and its commands as they stand, and every line of output that it shows.
#![allow(missing_docs, clippy::unwrap_used, clippy::print_stderr)]

use std::path::Path;
use std::process::Command;

/// A block of the page: its language and its text.
struct Block<'a> {
    language: &'a str,
    text: &'a str,
}

fn blocks(page: &str) -> Vec<Block<'_>> {
    // Between two fences.
    let inside = page.split("\n```").skip(1).step_by(2);
    inside
        .map(|block| {
            let (language, text) = block.split_once('\n').unwrap();
            Block { language, text }
        })
        .collect()
}

/// The words of a line, one blank between them.
fn plain(line: &str) -> String {
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A line of a shell in words: blanks separate, quotes hold together.
fn words(line: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut quoted = false;
    for letter in line.chars() {
        match letter {
            '"' => quoted = !quoted,
            ' ' if !quoted => words.push(String::new()),
            _ => words.last_mut().unwrap().push(letter),
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

#[test]
fn the_page_of_the_rig_says_what_its_commands_say() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/your-rig.md");
    let page = std::fs::read_to_string(page).unwrap();
    let blocks = blocks(&page);
    let folder = tempfile::tempdir().unwrap();
    let of = |language: &str| blocks.iter().filter(move |b| b.language == language).collect::<Vec<_>>();
    std::fs::write(folder.path().join("rig.py"), of("python")[0].text).unwrap();
    let Ok(made) = Command::new("python3").arg("rig.py").current_dir(folder.path()).status() else {
        eprintln!("skipped: there is no python3 to run the page's script");
        return;
    };
    assert!(made.success());
    let (mut said, mut shown) = (String::new(), 0);
    for block in &blocks {
        match block.language {
            "toml" if block.text.starts_with("name =") => {
                std::fs::write(folder.path().join("servo.toml"), block.text).unwrap();
            }
            "sh" => {
                said.clear();
                for line in block.text.replace("\\\n", " ").lines().filter(|line| !line.is_empty()) {
                    let words = words(line);
                    assert_eq!(words[0], "greybox", "{line}");
                    // The page goes on with its own model.
                    if words[1] == "new" {
                        continue;
                    }
                    let run = Command::new(env!("CARGO_BIN_EXE_greybox"))
                        .args(&words[1..])
                        .current_dir(folder.path())
                        .output()
                        .unwrap();
                    said += &String::from_utf8(run.stdout).unwrap();
                    let errors = String::from_utf8(run.stderr).unwrap();
                    assert!(run.status.success(), "{line}: {errors}");
                }
            }
            "text" => {
                // What the last command said, or the file that it wrote.
                let improved = std::fs::read_to_string(folder.path().join("second/improved.toml"));
                let all = format!("{said}\n{}", improved.unwrap_or_default());
                let all: Vec<String> = all.lines().map(plain).collect();
                for line in block.text.lines().map(plain).filter(|line| !line.is_empty() && line != "…") {
                    shown += 1;
                    assert!(all.contains(&line), "the page shows\n  {line}\nand the command says\n{said}");
                }
            }
            _ => {}
        }
    }
    assert!(shown > 30, "only {shown} lines are shown");
}
