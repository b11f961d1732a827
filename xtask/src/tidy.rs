//! What neither the compiler nor clippy checks about the repository.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use toml::{Table, Value};

use greybox_dev::{readme, root};

use crate::docs;

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn manifest(path: &Path) -> Table {
    toml::from_str(&read(path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The manifests of all packages of the workspace.
fn packages() -> Vec<(PathBuf, Table)> {
    let mut paths = vec![root().join("xtask").join("Cargo.toml")];
    for folder in ["crates", "dev", "examples"] {
        for entry in std::fs::read_dir(root().join(folder)).unwrap() {
            paths.push(entry.unwrap().path().join("Cargo.toml"));
        }
    }
    paths.sort();
    paths.into_iter().map(|p| (p.clone(), manifest(&p))).collect()
}

/// Text files under version control (all files outside `target` where git is not at hand).
fn files() -> Vec<PathBuf> {
    let listed = Command::new("git")
        .args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output();
    match listed {
        Ok(output) if output.status.success() && !output.stdout.is_empty() => {
            String::from_utf8(output.stdout)
                .unwrap()
                .split('\0')
                .filter(|name| !name.is_empty())
                .map(|name| root().join(name))
                .filter(|path| path.is_file())
                .collect()
        }
        _ => {
            let mut found = Vec::new();
            let mut folders = vec![root()];
            while let Some(folder) = folders.pop() {
                for entry in std::fs::read_dir(folder).unwrap() {
                    let path = entry.unwrap().path();
                    if path.is_dir() {
                        if !path.ends_with("target") && !path.ends_with(".git") {
                            folders.push(path);
                        }
                    } else {
                        found.push(path);
                    }
                }
            }
            found
        }
    }
}

#[test]
fn every_package_is_described_and_linted() {
    let workspace = manifest(&root().join("Cargo.toml"))["workspace"]["lints"].clone();
    for (path, manifest) in packages() {
        let package = manifest["package"].as_table().unwrap();
        let place = path.display();
        let description = package.get("description").and_then(Value::as_str).unwrap_or("");
        assert!(description.len() > 10, "{place}: `description` is missing");
        for key in ["license", "edition", "rust-version", "version"] {
            let inherited = package.get(key).and_then(|v| v.get("workspace")).and_then(Value::as_bool);
            assert_eq!(inherited, Some(true), "{place}: write `{key}.workspace = true`");
        }
        let lints = manifest.get("lints").and_then(|l| l.get("workspace")).and_then(Value::as_bool);
        if package["name"].as_str() == Some("greybox-jit") {
            // The same, but that `unsafe` may be allowed where it stands (`supply` says where).
            let mut own = manifest["lints"].as_table().unwrap().clone();
            own["rust"]["unsafe_code"] = workspace["rust"]["unsafe_code"].clone();
            for (tool, rules) in own {
                for (rule, level) in rules.as_table().unwrap() {
                    assert_eq!(workspace[&tool].get(rule), Some(level), "{place}: {rule}");
                }
            }
            continue;
        }
        assert_eq!(lints, Some(true), "{place}: write `[lints] workspace = true`");
    }
}

/// The packages that are for others: all that do not say `publish = false`.
fn published() -> Vec<(PathBuf, Table)> {
    let mut packages = packages();
    packages.retain(|(_, manifest)| manifest["package"].get("publish").is_none());
    for (path, _) in &mut packages {
        path.pop();
    }
    packages
}

/// Where the tests of a crate are one program, cargo does not look for files: one that is not listed would not be compiled.
#[test]
fn every_file_of_tests_is_compiled() {
    for (manifest, package) in packages() {
        if package["package"].get("autotests").is_none() {
            continue; // cargo finds them
        }
        let folder = manifest.with_file_name("tests");
        let program = read(&folder.join("all.rs"));
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap();
            if path.extension().is_some_and(|e| e == "rs") && name != "all" {
                assert!(
                    program.contains(&format!("mod {name};\n")),
                    "{} is in no test program",
                    path.display()
                );
            }
        }
    }
}

/// The categories of the registry that are in use here; others are refused when they are published.
const CATEGORIES: [&str; 9] = [
    "command-line-utilities",
    "embedded",
    "mathematics",
    "no-std",
    "no-std::no-alloc",
    "parser-implementations",
    "science",
    "simulation",
    "visualization",
];

/// Words of a list of the manifest.
fn words<'a>(package: &'a Table, key: &str) -> Vec<&'a str> {
    let list = package.get(key).and_then(Value::as_array);
    list.map(|l| l.iter().filter_map(Value::as_str).collect()).unwrap_or_default()
}

#[test]
fn every_crate_says_what_a_registry_asks() {
    let workspace = manifest(&root().join("Cargo.toml"));
    let common = workspace["workspace"]["package"].as_table().unwrap();
    let published = published();
    assert!(published.len() >= 17, "only {} crates are published", published.len());
    for (folder, manifest) in published {
        let (place, package) = (folder.display(), manifest["package"].as_table().unwrap());
        for key in common.keys() {
            let inherited = package.get(key).and_then(|v| v.get("workspace")).and_then(Value::as_bool);
            assert_eq!(inherited, Some(true), "{place}: write `{key}.workspace = true`");
        }
        let keywords = words(package, "keywords");
        assert!((1..=5).contains(&keywords.len()), "{place}: one to five keywords");
        for word in keywords {
            let plain = word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
            assert!(plain && word.len() <= 20, "{place}: the keyword {word:?} is too long or not plain");
        }
        let categories = words(package, "categories");
        assert!((1..=5).contains(&categories.len()), "{place}: one to five categories");
        for category in categories {
            assert!(CATEGORIES.contains(&category), "{place}: {category:?} is not in CATEGORIES");
        }
        assert_eq!(package.get("readme").and_then(Value::as_str), Some("README.md"), "{place}: `readme`");
        assert_eq!(read(&folder.join("LICENSE")), read(&root().join("LICENSE")), "{place}: LICENSE");
    }
}

#[test]
fn every_crate_has_a_readme_whose_example_is_run() {
    for (folder, manifest) in published() {
        let (place, text) = (folder.display(), read(&folder.join("README.md")));
        let name = manifest["package"]["name"].as_str().unwrap();
        assert!(text.starts_with(&format!("# {name}\n")), "{place}: the README's title is not {name}");
        for needed in ["## What it does not do\n", "Licence: MIT"] {
            assert!(text.contains(needed), "{place}: the README lacks {needed:?}");
        }
        let library = folder.join("src").join("lib.rs");
        if !library.is_file() {
            assert!(!blocks(&text, "sh").is_empty(), "{place}: the README shows no command");
            continue;
        }
        let code = read(&library);
        assert!(!blocks(&text, "rust").is_empty(), "{place}: the README has no example that is run");
        assert!(
            code.contains("doc = include_str!(\"../README.md\")"),
            "{place}: nothing runs the README's example"
        );
        let promised = if code.contains("#![no_std]") { "`no_std` without features" } else { "needs `std`" };
        assert!(text.contains(promised), "{place}: the README does not say {promised:?}");
        let categories = words(manifest["package"].as_table().unwrap(), "categories");
        let said = categories.contains(&"no-std");
        assert_eq!(said, code.contains("#![no_std]"), "{place}: the category `no-std`");
    }
}

/// Files of a package as it would be published, by their names in it.
fn packaged(name: &str) -> Vec<String> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let listed = Command::new(cargo)
        .args(["package", "--list", "--locked", "--offline", "--allow-dirty", "--package", name])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
    String::from_utf8(listed.stdout).unwrap().lines().map(|line| line.replace('\\', "/")).collect()
}

/// Texts in a line of code that lead out of the package, from a file `depth` folders below its root. Those that are
/// joined to the root start there. Recordings and reference data beside the repository (`../shared`) may be missing.
fn leads_out(line: &str, depth: usize) -> bool {
    let depth = if line.contains(".join(") { 0 } else { depth };
    let texts = line.split('"').skip(1).step_by(2);
    texts.filter(|t| !t.contains("../shared/")).any(|text| {
        let ups = text.split('/').take_while(|part| *part == "..").count();
        ups > depth
    })
}

#[test]
fn a_path_out_of_a_package_is_told_from_one_inside() {
    assert!(leads_out("include_str!(\"../../../docs/src/page.md\")", 1));
    assert!(leads_out("Path::new(env!(\"CARGO_MANIFEST_DIR\")).join(\"../cli\")", 2));
    assert!(leads_out("    .join(\"../../docs\")", 2));
    assert!(!leads_out("#![doc = include_str!(\"../README.md\")]", 1));
    assert!(!leads_out("include_str!(\"../../demo/cart.toml\")", 2));
    assert!(!leads_out("Path::new(env!(\"CARGO_MANIFEST_DIR\")).join(\"../../../shared/trust\")", 1));
}

#[test]
fn a_published_crate_needs_no_file_outside_of_it() {
    let mut found = Vec::new();
    for (folder, manifest) in published() {
        let name = manifest["package"]["name"].as_str().unwrap();
        let files = packaged(name);
        for needed in ["Cargo.toml", "LICENSE", "README.md"] {
            assert!(files.iter().any(|f| f == needed), "{name}: the package lacks {needed}");
        }
        for file in files.iter().filter(|f| f.ends_with(".rs")) {
            let depth = file.matches('/').count();
            for (k, line) in read(&folder.join(file)).lines().enumerate() {
                if leads_out(line, depth) {
                    found.push(format!("{name}: {file}:{}: {}", k + 1, line.trim()));
                }
            }
        }
    }
    assert!(found.is_empty(), "these leave their package; move or exclude them:\n{}", found.join("\n"));
}

#[test]
fn our_crates_are_asked_for_in_the_version_they_have() {
    let workspace = manifest(&root().join("Cargo.toml"));
    let version = &workspace["workspace"]["package"]["version"];
    for (name, value) in workspace["workspace"]["dependencies"].as_table().unwrap() {
        // Those of `dev` are not published.
        if value.get("path").and_then(Value::as_str).is_some_and(|path| path.starts_with("crates/")) {
            assert_eq!(value.get("version"), Some(version), "Cargo.toml: {name}");
        }
    }
}

/// Names of the dependencies of a package that come from the workspace, and of those that do not.
fn dependencies(manifest: &Table) -> (BTreeSet<String>, BTreeSet<String>) {
    let (mut shared, mut own) = (BTreeSet::new(), BTreeSet::new());
    let targets = manifest.get("target").and_then(Value::as_table).into_iter().flatten();
    for table in targets.filter_map(|(_, of)| of.as_table()).chain([manifest]) {
        for key in ["dependencies", "dev-dependencies", "build-dependencies"] {
            for (name, value) in table.get(key).and_then(Value::as_table).into_iter().flatten() {
                let from_workspace = value.get("workspace").and_then(Value::as_bool) == Some(true);
                if from_workspace { &mut shared } else { &mut own }.insert(name.clone());
            }
        }
    }
    (shared, own)
}

#[test]
fn dependencies_are_stated_once_and_used() {
    let workspace = manifest(&root().join("Cargo.toml"));
    let stated: BTreeSet<String> =
        workspace["workspace"]["dependencies"].as_table().unwrap().keys().cloned().collect();
    let mut used = BTreeSet::new();
    for (path, manifest) in packages() {
        let (shared, own) = dependencies(&manifest);
        assert!(own.is_empty(), "{}: state {own:?} in the workspace's manifest", path.display());
        used.extend(shared);
    }
    let unused: Vec<&String> = stated.difference(&used).collect();
    assert!(unused.is_empty(), "Cargo.toml: no package uses {unused:?}; remove them");
}

#[test]
fn no_file_names_a_path_of_one_machine() {
    // Put together here, so that this file does not name them.
    let paths: Vec<String> = ["work", "tmp/wt", "home", "root"].iter().map(|p| format!("/{p}/")).collect();
    let mut found = Vec::new();
    for file in files() {
        let Ok(text) = std::fs::read_to_string(&file) else { continue };
        for (k, line) in text.lines().enumerate() {
            if let Some(path) = paths.iter().find(|p| mentions(line, p)) {
                found.push(format!("{}:{}: {path}", file.display(), k + 1));
            }
        }
    }
    assert!(found.is_empty(), "paths of one machine:\n{}", found.join("\n"));
}

/// What git leaves where a merge is to be decided by hand.
#[test]
fn no_merge_is_left_undecided() {
    let is_mark = |line: &&str| ["<<<<<<< ", ">>>>>>> "].iter().any(|mark| line.starts_with(mark));
    // (What is no text holds none.)
    let is_undecided =
        |path: &PathBuf| std::fs::read_to_string(path).is_ok_and(|text| text.lines().any(|l| is_mark(&l)));
    let left: Vec<PathBuf> = files().into_iter().filter(is_undecided).collect();
    assert!(left.is_empty(), "{left:?}");
}

/// Words that stood where the field has a term, and the term.
const REPLACED: [(&str, &str); 18] = [
    ("anneal", "restart_short_segments"),
    ("declare_unseen", "mark_unidentifiable"),
    ("hats", "smoothed_states"),
    ("Hats", "SmoothedStates"),
    ("is_patchwork", "is_series_expansion"),
    ("is_rivalled", "beaten_by_discrepancy"),
    ("kappa", "effective_sample_ratio"),
    ("least_kappa", "least_effective_sample_ratio"),
    ("Manner", "OutputFormat"),
    ("mend", "help, or fix"),
    ("mended", "fixed, or corrected"),
    ("mends", "fixes"),
    ("Polished", "WholeRecordFit"),
    ("Rival", "AlternativeTerm"),
    ("rival", "alternative"),
    ("rivals", "alternatives"),
    ("think_again", "refine_structure"),
    ("Untold", "WorkOnlyListener"),
];

/// Uses of replaced words in a text, by line.
fn replaced(text: &str) -> Vec<(usize, &'static str, &'static str)> {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    let of = |(number, line): (usize, &str)| {
        let words: Vec<&str> = line.split(|c| !is_part(c)).collect();
        let used = REPLACED.iter().filter(|(word, _)| words.contains(word));
        used.map(|&(word, term)| (number + 1, word, term)).collect::<Vec<_>>()
    };
    text.lines().enumerate().flat_map(of).collect()
}

#[test]
fn a_replaced_word_is_found_as_a_whole_word_only() {
    assert_eq!(replaced("the recommended\n= mend: `k`"), [(2, "mend", "help, or fix")]);
    assert!(replaced("that chats").is_empty());
}

/// Names and prose say what a reader of the field would search for.
#[test]
fn no_word_of_our_own_stands_for_a_term_of_the_field() {
    // This list, the old key that is still read, and the Greek letter's name.
    let may = [
        "xtask/src/tidy.rs",
        "CHANGELOG.md",
        "crates/report/src/expression.rs",
        "crates/export/src/latex.rs",
    ];
    // As code reads it, as documents have it, and as pages speak of it.
    let old_key = ["alias = \"mend\"", "\"mend\":", "`findings[].mend`", "was called `mend`"];
    let is_old_key = |line: &str| old_key.iter().any(|form| line.contains(form));
    let mut found = Vec::new();
    for path in files() {
        let name = path.strip_prefix(root()).unwrap().to_string_lossy().into_owned();
        let is_text =
            ["rs", "md", "html", "css", "py", "pyi"].iter().any(|e| name.ends_with(&format!(".{e}")));
        if !is_text || may.contains(&name.as_str()) {
            continue;
        }
        let text = read(&path);
        let lines: Vec<&str> = text.lines().collect();
        let here = replaced(&text).into_iter().filter(|(line, _, _)| !is_old_key(lines[line - 1]));
        found.extend(here.map(|(line, word, term)| format!("{name}:{line}: `{word}` is called {term}")));
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Whether a line holds the path as an absolute one (`../work/x` and `a/work/x` are relative).
fn mentions(line: &str, path: &str) -> bool {
    line.match_indices(path).any(|(at, _)| {
        !line[..at].chars().next_back().is_some_and(|c| c.is_alphanumeric() || "._-$}".contains(c))
    })
}

#[test]
fn an_absolute_path_is_told_from_a_relative_one() {
    assert!(mentions("see \"/x/y\"", "/x/"));
    assert!(mentions("/x/y", "/x/"));
    assert!(!mentions("../x/y", "/x/"));
    assert!(!mentions("a/x/y", "/x/"));
}

#[test]
fn the_readme_states_the_commands_that_ci_runs() {
    let text = read(&root().join("README.md"));
    let test = readme::block_after(&text, "test command").unwrap();
    assert_eq!(test, "cargo test --release --workspace --locked\n");
    let main = readme::block_after(&text, "main command").unwrap();
    assert!(main.contains("greybox demo"), "the main command is the demo: {main}");
    let script = read(&root().join(".ci").join("run"));
    for marker in ["test command", "main command"] {
        assert!(script.contains(&format!("\"{marker}\"")), ".ci/run does not run the README's {marker}");
    }
}

#[test]
fn the_generated_pages_are_up_to_date() {
    for (path, wanted) in docs::pages(&root()).unwrap() {
        assert!(
            docs::is_current(&path, wanted.as_deref()),
            "{} is stale: run `cargo xtask docs` and commit it",
            path.display()
        );
    }
}

/// Pages of the book, those of the kinds included.
fn pages() -> Vec<PathBuf> {
    let book = root().join("docs").join("src");
    let mut pages = Vec::new();
    for folder in [book.join("mechanisms"), book] {
        pages.extend(std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()));
    }
    pages.retain(|p| p.extension().is_some_and(|e| e == "md"));
    pages.sort();
    pages
}

/// Fenced blocks of a language: (line, text).
fn blocks(text: &str, language: &str) -> Vec<(usize, String)> {
    let mut blocks: Vec<(usize, String)> = Vec::new();
    let mut inside: Option<bool> = None;
    for (k, line) in text.lines().enumerate() {
        if let Some(info) = line.strip_prefix("```") {
            inside = match inside {
                Some(_) => None,
                None => {
                    let wanted = info.trim() == language;
                    if wanted {
                        blocks.push((k + 1, String::new()));
                    }
                    Some(wanted)
                }
            };
        } else if inside == Some(true)
            && let Some((_, block)) = blocks.last_mut()
        {
            block.push_str(line);
            block.push('\n');
        }
    }
    blocks
}

#[test]
fn the_book_lists_every_page_and_links_to_pages_that_exist() {
    let folder = root().join("docs").join("src");
    let summary = read(&folder.join("SUMMARY.md"));
    for page in pages() {
        let name = page.strip_prefix(&folder).unwrap().to_str().unwrap().replace('\\', "/");
        assert!(name == "SUMMARY.md" || summary.contains(&format!("({name})")), "SUMMARY.md lacks {name}");
        for link in read(&page).split("](").skip(1).filter_map(|s| s.split(')').next()) {
            let file = link.split('#').next().unwrap_or("");
            if file.ends_with(".md") {
                let place = page.parent().unwrap_or(&folder);
                assert!(place.join(file).is_file(), "{name} links to {file}, which does not exist");
            }
        }
    }
}

/// A block ```` ```toml ```` is a model, a mechanism, or a part of one to be read; models and mechanisms
/// must load. What must fail is marked ```` ```toml,error ````.
#[test]
fn models_and_mechanisms_in_the_book_load() {
    let mut loaded = 0;
    for page in pages() {
        let (text, name) = (read(&page), page.file_name().unwrap().to_str().unwrap());
        for (line, block) in blocks(&text, "toml") {
            if block.contains("[equations]") {
                greybox_model::Model::from_toml(&block, name)
                    .unwrap_or_else(|e| panic!("{name}, line {line}: {e}"));
                loaded += 1;
            } else if block.contains("kind ") {
                greybox_diagnose::Mechanism::from_toml(&block, name)
                    .unwrap_or_else(|e| panic!("{name}, line {line}: {e}"));
                loaded += 1;
            }
        }
        for (line, block) in blocks(&text, "toml,error") {
            let error = greybox_model::Model::from_toml(&block, name)
                .err()
                .unwrap_or_else(|| panic!("{name}, line {line}: the model loads, though it should not"))
                .to_string();
            // The message of the page is the message of the program.
            let (_, message) = error.split_once(": ").unwrap();
            assert!(text.contains(message), "{name}, line {line}: the page does not quote `{message}`");
            loaded += 1;
        }
    }
    assert!(loaded >= 5, "only {loaded} examples were found");
}

/// Name and version of every package of a lock file.
fn locked(path: &Path) -> BTreeSet<(String, String)> {
    let text = |package: &Value, key: &str| package[key].as_str().unwrap_or_default().to_owned();
    let lock = manifest(path);
    lock["package"].as_array().unwrap().iter().map(|p| (text(p, "name"), text(p, "version"))).collect()
}

#[test]
fn the_python_package_has_the_dependencies_of_the_command() {
    let ours = locked(&root().join("Cargo.lock"));
    let names: BTreeSet<&String> = ours.iter().map(|(name, _)| name).collect();
    let package = locked(&root().join("python").join("Cargo.lock"));
    let strays: Vec<_> = package.iter().filter(|p| names.contains(&p.0) && !ours.contains(p)).collect();
    assert!(strays.is_empty(), "python/Cargo.lock: other versions than Cargo.lock: {strays:?}");
}

#[test]
fn the_python_package_is_the_version_of_the_workspace() {
    let workspace = manifest(&root().join("Cargo.toml"));
    let package = manifest(&root().join("python").join("Cargo.toml"));
    for key in ["version", "edition", "rust-version", "license"] {
        assert_eq!(
            package["package"][key], workspace["workspace"]["package"][key],
            "python/Cargo.toml: {key}"
        );
    }
    for key in ["lto", "codegen-units"] {
        assert_eq!(package["profile"]["release"][key], workspace["profile"]["release"][key], "{key}");
    }
}
