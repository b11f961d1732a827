//! No module of a crate imports, directly or through others, what imports it: one can be read after the other.
//!
//! A module here is one of the crate's own (`src/NAME.rs` with all of `src/NAME/`); what it uses of another is read from
//! `crate::…` and, in `src/NAME.rs`, `super::…`. Tests may use what they like.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use greybox_dev::root;

/// The modules of a crate and those that each uses.
type Uses = BTreeMap<String, BTreeSet<String>>;

/// A source file up to its tests, without comments.
fn code(text: &str) -> String {
    let tests = text.find("\n#[cfg(test)]\nmod tests").unwrap_or(text.len());
    let lines = text[..tests].lines().map(|line| line.split("//").next().unwrap_or_default());
    lines.collect::<Vec<_>>().join("\n")
}

/// The first names behind each `prefix` in a source: one, or those of a group in braces.
fn names(code: &str, prefix: &str) -> BTreeSet<String> {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices(prefix) {
        let rest = &code[at + prefix.len()..];
        let Some(group) = rest.strip_prefix('{') else {
            found.insert(rest.chars().take_while(|c| is_part(*c)).collect());
            continue;
        };
        let mut depth = 0;
        let mut name = String::new();
        for c in group.chars() {
            match c {
                '}' if depth == 0 => break,
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    found.insert(std::mem::take(&mut name));
                }
                _ if depth == 0 => name.push(c),
                _ => {}
            }
        }
        found.insert(name);
    }
    let first = |name: &String| name.trim().chars().take_while(|c| is_part(*c)).collect::<String>();
    found.iter().map(first).filter(|name| !name.is_empty()).collect()
}

/// What the modules `files` (name, whether it is the module's own file, source) use of each other; `library` is the crate's
/// root, whose re-exports lead to their modules.
fn uses(files: &[(String, bool, String)], library: &str) -> Uses {
    let modules: BTreeSet<&String> = files.iter().map(|(module, ..)| module).collect();
    let mut exported: BTreeMap<String, &String> = BTreeMap::new();
    for statement in code(library).split(';') {
        let Some((_, path)) = statement.split_once("use ") else { continue };
        let path = path.trim().trim_start_matches("self::").trim_start_matches("crate::");
        let module = path.split("::").next().unwrap_or_default().to_owned();
        let Some(module) = modules.get(&module) else { continue };
        let last = path.rsplit_once("::").map_or("", |(_, last)| last);
        let items = path.split_once('{').map_or(last, |(_, items)| items).trim_end_matches('}');
        for item in items.split(',') {
            let name = item.rsplit(" as ").next().unwrap_or_default().trim().to_owned();
            exported.insert(name, module);
        }
    }
    let mut uses = Uses::new();
    for (module, is_own, text) in files {
        let code = code(text);
        let mut used = names(&code, "crate::");
        if *is_own {
            used.extend(names(&code, "super::"));
        }
        let target = |name: &String| modules.get(name).copied().or_else(|| exported.get(name).copied());
        let used = used.iter().filter_map(target).filter(|other| *other != module).cloned();
        uses.entry(module.clone()).or_default().extend(used);
    }
    uses
}

/// A way from a module through others back to it.
fn circle(uses: &Uses) -> Option<Vec<&str>> {
    fn back<'u>(uses: &'u Uses, way: &mut Vec<&'u str>, seen: &mut BTreeSet<&'u str>) -> bool {
        let Some(last) = way.last().and_then(|last| uses.get(*last)) else { return false };
        for next in last {
            if *next == way[0] {
                way.push(next);
                return true;
            }
            if seen.insert(next) {
                way.push(next);
                if back(uses, way, seen) {
                    return true;
                }
                way.pop();
            }
        }
        false
    }
    uses.keys().find_map(|start| {
        let mut way = vec![start.as_str()];
        back(uses, &mut way, &mut BTreeSet::new()).then_some(way)
    })
}

/// The source files of a crate: module, whether the file is the module's own, text.
fn files(source: &Path) -> Vec<(String, bool, String)> {
    let mut found = Vec::new();
    let mut folders = vec![source.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let inside = path.strip_prefix(source).unwrap().with_extension("");
            let module = inside.iter().next().unwrap().to_string_lossy().into_owned();
            if path.extension().is_some_and(|e| e == "rs") && !["lib", "main"].contains(&&*module) {
                found.push((module, inside.iter().count() == 1, std::fs::read_to_string(&path).unwrap()));
            }
        }
    }
    found
}

#[test]
fn no_modules_import_each_other_in_a_circle() {
    let mut folders = vec![root().join("xtask"), root().join("python")];
    for folder in ["crates", "dev"] {
        folders.extend(std::fs::read_dir(root().join(folder)).unwrap().map(|entry| entry.unwrap().path()));
    }
    let mut found = Vec::new();
    for source in folders.iter().map(|folder| folder.join("src")) {
        let roots = ["lib.rs", "main.rs"].map(|file| std::fs::read_to_string(source.join(file)));
        let library = roots.into_iter().find_map(Result::ok).unwrap();
        if let Some(way) = circle(&uses(&files(&source), &library)) {
            found.push(format!("{}: {}", source.display(), way.join(" → ")));
        }
    }
    assert!(
        found.is_empty(),
        "modules import each other in a circle; name what they share:\n{}",
        found.join("\n")
    );
}

#[test]
fn a_circle_is_found_through_other_modules_groups_and_re_exports() {
    let file = |module: &str, text: &str| (module.to_owned(), true, text.to_owned());
    let a = file("a", "use crate::{b::{self, X}, other};\n// use crate::c;\n");
    let b = file("b", "use crate::Made;\n#[cfg(test)]\nmod tests { use crate::a; }");
    let library = "mod a;\npub use a::{Thing, go};\npub use c::inner::{self, Made as Made};\n";
    let c = |text: &str| file("c", text);
    let found = |c: (String, bool, String)| {
        circle(&uses(&[a.clone(), b.clone(), c], library))
            .map(|way| way.into_iter().map(str::to_owned).collect::<Vec<_>>())
    };
    assert_eq!(found(c("fn f() {}")), None);
    assert_eq!(found(c("fn f() { super::a::go() }")).unwrap(), ["a", "b", "c", "a"]);
    assert_eq!(found(c("use crate::go;")).unwrap(), ["a", "b", "c", "a"]);
}
