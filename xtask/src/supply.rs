//! What greybox is made of, held against `supply.toml`: licences, build scripts, default features, `unsafe`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use serde_json::Value as Json;
use toml::{Table, Value};

use greybox_dev::root;

/// The manifests of our workspaces.
const WORKSPACES: [&str; 3] = ["Cargo.toml", "python/Cargo.toml", "fuzz/Cargo.toml"];

/// Packages that open connections, on their own or for others. (Rustls opens none: it encrypts what it is given.)
const NETWORK: [&str; 13] = [
    "attohttpc",
    "async-std",
    "curl",
    "curl-sys",
    "git2",
    "hyper",
    "isahc",
    "mio",
    "openssl-sys",
    "reqwest",
    "socket2",
    "tokio",
    "ureq",
];

/// What a build script that loads something would say.
const LOADING: [&str; 8] = [
    "tcpstream",
    "udpsocket",
    "tosocketaddrs",
    "\"curl\"",
    "\"wget\"",
    "powershell",
    "download",
    "git clone",
];

fn policy() -> Table {
    toml::from_str(&std::fs::read_to_string(root().join("supply.toml")).unwrap()).unwrap()
}

/// Every package of the lock files, as Cargo describes it.
fn packages() -> Vec<Json> {
    let mut found = BTreeMap::new();
    for manifest in WORKSPACES {
        let output = Command::new(env!("CARGO"))
            .args(["metadata", "--format-version", "1", "--locked", "--all-features", "--manifest-path"])
            .arg(root().join(manifest))
            .output()
            .unwrap();
        assert!(output.status.success(), "{manifest}: {}", String::from_utf8_lossy(&output.stderr));
        let metadata: Json = serde_json::from_slice(&output.stdout).unwrap();
        for package in metadata["packages"].as_array().unwrap() {
            found.insert(package["id"].as_str().unwrap().to_owned(), package.clone());
        }
    }
    found.into_values().collect()
}

fn name(package: &Json) -> &str {
    package["name"].as_str().unwrap()
}

fn is_ours(package: &Json) -> bool {
    package["source"].is_null()
}

fn strings(value: &Value) -> BTreeSet<String> {
    value.as_array().unwrap().iter().map(|v| v.as_str().unwrap().to_owned()).collect()
}

/// The allowed licences that an SPDX expression is met with: one of each alternative; `None` if some part has none.
fn met<'a>(expression: &str, allowed: &[&'a str]) -> Option<Vec<&'a str>> {
    let parts = expression.split(" AND ").map(|part| {
        let part = part.trim_matches(['(', ')']).replace('/', " OR ");
        allowed.iter().find(|a| part.split(" OR ").any(|p| p.trim() == **a)).copied()
    });
    parts.collect()
}

#[test]
fn every_licence_is_allowed_and_every_allowed_one_is_needed() {
    let policy = policy();
    let allowed: Vec<&str> = policy["licences"].as_table().unwrap().keys().map(String::as_str).collect();
    let (mut refused, mut needed) = (Vec::new(), BTreeSet::new());
    for package in packages() {
        let licence = package["license"].as_str().unwrap_or("none");
        match met(licence, &allowed) {
            Some(_) => {}
            None => refused.push(format!("{} {}: {licence}", name(&package), package["version"])),
        }
        needed.extend(allowed.iter().filter(|a| licence.contains(**a)).copied());
    }
    assert!(refused.is_empty(), "not in supply.toml:\n{}", refused.join("\n"));
    assert_eq!(needed, allowed.iter().copied().collect(), "an allowed licence occurs nowhere");
}

#[test]
fn expressions_of_licences_are_read() {
    let allowed = ["MIT", "Zlib"];
    assert_eq!(met("MIT OR GPL-3.0", &allowed), Some(vec!["MIT"]));
    assert_eq!(met("Apache-2.0/MIT", &allowed), Some(vec!["MIT"]));
    assert_eq!(met("(MIT OR Apache-2.0) AND Zlib", &allowed), Some(vec!["MIT", "Zlib"]));
    assert_eq!(met("(MIT OR Apache-2.0) AND GPL-3.0", &allowed), None);
    assert_eq!(met("GPL-3.0", &allowed), None);
    assert_eq!(met("MIT-0", &allowed), None);
}

#[test]
fn packages_come_from_the_registry_and_open_no_connection() {
    for package in packages() {
        let source = package["source"].as_str();
        assert!(source.is_none_or(|s| s.starts_with("registry+")), "{}: {source:?}", name(&package));
        assert!(!NETWORK.contains(&name(&package)), "{} opens connections", name(&package));
    }
}

/// The source of a package's build script, if it has one, and all that lies beside it where it has a folder of its own.
fn build_script(package: &Json) -> Option<String> {
    let targets = package["targets"].as_array().unwrap();
    let script = targets.iter().find(|t| t["kind"][0] == "custom-build")?;
    let path = Path::new(script["src_path"].as_str().unwrap());
    let folder = path.parent().unwrap();
    if package["manifest_path"].as_str().map(Path::new).and_then(Path::parent) == Some(folder) {
        return Some(std::fs::read_to_string(path).unwrap());
    }
    let files = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    Some(files.filter_map(|f| std::fs::read_to_string(f).ok()).collect())
}

/// Without comments: they link to explanations.
fn code(text: &str) -> String {
    let lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    lines.map(|line| format!("{}\n", line.to_lowercase())).collect()
}

#[test]
fn the_build_scripts_are_those_that_are_stated_and_load_nothing() {
    let policy = policy();
    let mut stated = BTreeSet::new();
    for (group, entry) in policy["build-scripts"].as_table().unwrap() {
        assert!(entry["why"].as_str().is_some_and(|why| why.len() > 20), "{group}: no reason");
        for package in strings(&entry["packages"]) {
            assert!(stated.insert(package.clone()), "{package} stands twice");
        }
    }
    let mut found = BTreeSet::new();
    for package in packages() {
        let Some(script) = build_script(&package) else { continue };
        let script = code(&script);
        let word = LOADING.iter().find(|word| script.contains(**word));
        assert!(word.is_none(), "{}: its build script says {word:?}", name(&package));
        if !is_ours(&package) {
            found.insert(name(&package).to_owned());
        }
    }
    assert_eq!(found, stated, "build scripts that run, and those that supply.toml states");
}

#[test]
fn few_features_are_on_by_default() {
    let policy = policy();
    let stated = policy["default-features"].as_table().unwrap();
    for package in packages().iter().filter(|p| is_ours(p)) {
        let wanted = stated.get(name(package)).map(|s| strings(&s["features"])).unwrap_or_default();
        let default = package["features"]["default"].as_array().into_iter().flatten();
        let found: BTreeSet<String> = default.map(|f| f.as_str().unwrap().to_owned()).collect();
        assert_eq!(found, wanted, "{}: its default features", name(package));
    }
}

/// There is no `unsafe` of ours but where compiled programs are run. Other packages of the workspace inherit its lints (see
/// `tidy`), so that the compiler looks.
#[test]
fn the_compiler_forbids_unsafe_code() {
    let lint = |manifest: &str, lints: &[&str]| {
        let table: Table = toml::from_str(&std::fs::read_to_string(root().join(manifest)).unwrap()).unwrap();
        let lints = lints.iter().fold(&table, |table, key| table[*key].as_table().unwrap());
        lints["rust"]["unsafe_code"].as_str().unwrap().to_owned()
    };
    assert_eq!(lint("Cargo.toml", &["workspace", "lints"]), "forbid");
    assert_eq!(lint("fuzz/Cargo.toml", &["lints"]), "forbid");
    // The macros of PyO3 allow it for what they write, which `forbid` would refuse.
    assert_eq!(lint("python/Cargo.toml", &["lints"]), "deny");
    let holds_unsafe = |folder: &str| -> BTreeSet<String> {
        let files = std::fs::read_dir(root().join(folder)).unwrap().map(|file| file.unwrap().path());
        let holds = files.filter(|path| std::fs::read_to_string(path).unwrap().contains("unsafe"));
        holds.map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect()
    };
    assert_eq!(holds_unsafe("python/src"), BTreeSet::new());
    // The checks of what a program is given, and the two functions that run it.
    assert_eq!(lint("crates/jit/Cargo.toml", &["lints"]), "deny");
    let expected: BTreeSet<String> = ["memory.rs", "native.rs"].map(String::from).into();
    assert_eq!(holds_unsafe("crates/jit/src"), expected);
}
