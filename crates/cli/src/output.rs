//! Writing results whole or not at all.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use crate::failure::Failure;
use crate::loading::same_file;

/// A folder for the results of one command.
///
/// [`prepare`](Self::prepare) finds out early whether the folder can be written, and leaves no trace;
/// [`write`](Self::write) makes all files appear, or none.
#[derive(Debug)]
pub(crate) struct OutputFolder {
    path: PathBuf,
    /// Tells its files that wait from those of other folders of this process.
    number: usize,
    /// This process keeps it ([`keep`](Self::keep)).
    kept: AtomicBool,
}

/// What a file of a new folder holds.
#[derive(Debug)]
pub(crate) enum Content {
    /// This text.
    Text(String),
    /// What the file at this path holds.
    Copy(PathBuf),
}

/// How many folders this process has made.
static FOLDERS: AtomicUsize = AtomicUsize::new(0);

/// Name of the files that wait: head, number of the process, number of the folder, tail.
const WAITING: (&str, &str) = (".greybox-", ".partial");
/// Files that wait for longer, and that nobody holds, were left by a run that was killed.
const FORGOTTEN: Duration = Duration::from_secs(60);
/// Longest that a run waits for another one that is moving its files into the same folder, in steps.
const TURN: (u32, Duration) = (200, Duration::from_millis(10));

impl OutputFolder {
    /// The folder at `path`, which need not exist.
    ///
    /// # Errors
    /// Bad input when `path` or something above it is a file, or the folder cannot be written.
    pub(crate) fn prepare(path: &Path) -> Result<OutputFolder, Failure> {
        let number = FOLDERS.fetch_add(1, Ordering::Relaxed);
        let folder = OutputFolder { path: path.to_owned(), number, kept: AtomicBool::new(false) };
        if path.as_os_str().is_empty() {
            return Err(
                Failure::input("the output folder has no name").help("give one, such as `--out result`")
            );
        }
        if path.is_file() {
            return Err(Failure::file(path, "this is a file, but the results need a folder")
                .help("name another folder after `--out`, or move the file away"));
        }
        if let Some(file) = path.ancestors().skip(1).find(|p| p.is_file()) {
            return Err(Failure::file(path, format!("`{}` is a file, not a folder", file.display()))
                .help("name another path after `--out`"));
        }
        let stage = folder.stage();
        fs::create_dir(&stage).and_then(|()| fs::remove_dir(&stage)).map_err(|e| folder.refused(&e))?;
        Ok(folder)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Sees that writing `names` here would not replace one of `inputs`.
    ///
    /// # Errors
    /// Bad input, naming the file that would be lost.
    pub(crate) fn spares<'a>(
        &self,
        names: &[&str],
        inputs: impl IntoIterator<Item = &'a PathBuf>,
    ) -> Result<(), Failure> {
        for input in inputs {
            if let Some(name) = names.iter().find(|name| same_file(&self.path.join(name), input)) {
                return Err(Failure::file(input, format!("the new {name} would overwrite this input"))
                    .help("name another folder after `--out`"));
            }
        }
        Ok(())
    }

    /// Sees that no file of the name is here, other than one of the same content.
    ///
    /// # Errors
    /// Bad input, naming the file that would be lost.
    pub(crate) fn spares_other(&self, files: &[(&str, &[u8])]) -> Result<(), Failure> {
        for (name, content) in files {
            let path = self.path.join(name);
            if path.exists() && !fs::read(&path).is_ok_and(|old| old == *content) {
                return Err(Failure::file(&path, "this file is there already, and is not of this demo")
                    .help("name another folder after `--out`"));
            }
        }
        Ok(())
    }

    /// Writes `files` (name, content). The folder and those above it are made where they are missing;
    /// files of the same names are replaced, others stay.
    ///
    /// # Errors
    /// Bad input when the folder cannot be written, or something else than an ordinary file has the name
    /// of a result; then everything is as it was before.
    pub(crate) fn write(&self, files: &[(&str, &[u8])]) -> Result<(), Failure> {
        for (name, _) in files {
            ordinary(&self.path.join(name))?;
        }
        self.staged(|stage| {
            for (name, content) in files {
                fs::write(stage.join(name), content)?;
            }
            if self.path.is_dir() {
                return self.replace(stage, files);
            }
            match self.appear(stage) {
                // Another run has made the folder meanwhile.
                Err(_) if self.path.is_dir() => self.replace(stage, files),
                appeared => appeared,
            }
        })
    }

    /// Writes `files` (name, content) to a folder that is not there yet; names may have folders.
    ///
    /// # Errors
    /// Bad input when the folder is there, or it or a file cannot be written; then nothing is.
    pub(crate) fn write_new(&self, files: &[(String, Content)]) -> Result<(), Failure> {
        self.staged(|stage| {
            for (name, content) in files {
                let path = stage.join(name);
                if let Some(parent) = path.parent() {
                    fs::create_dir_all(parent)?;
                }
                match content {
                    Content::Text(text) => fs::write(&path, text)?,
                    Content::Copy(from) => drop(fs::copy(from, &path)?),
                }
            }
            self.appear(stage)
        })
    }

    /// Does `work` with a folder for files that wait, which is gone afterwards.
    fn staged(&self, work: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), Failure> {
        let stage = self.stage();
        if let Some(near) = stage.parent() {
            sweep(near);
        }
        let result = fs::create_dir(&stage).and_then(|()| {
            let _held = locked(&stage);
            work(&stage)
        });
        // Gone already where it became the folder itself.
        let _ = fs::remove_dir_all(&stage);
        result.map_err(|e| self.refused(&e))
    }

    /// The staged files become the folder.
    fn appear(&self, stage: &Path) -> io::Result<()> {
        if let Some(parent) = self.path.parent() {
            fs::create_dir_all(parent)?;
        }
        fs::rename(stage, &self.path)
    }

    /// The folder held while files are moved into it, so that of two runs each moves all of its own. A wait has its end:
    /// a run that keeps the folder for long writes beside these files.
    fn turn(&self) -> Option<File> {
        if self.kept.load(Ordering::Relaxed) {
            return None;
        }
        let (steps, step) = TURN;
        (0..steps).find_map(|_| {
            let held = locked(&self.path);
            if held.is_none() {
                thread::sleep(step);
            }
            held
        })
    }

    /// Makes the folder and keeps it for this process until the value returned is dropped, also by a kill. What a run
    /// that was killed left waiting here goes.
    ///
    /// # Errors
    /// Bad input when the folder cannot be made, or another process has it.
    pub(crate) fn keep(&self) -> Result<Kept, Failure> {
        let above = self.path.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.is_dir());
        let made = above.map(Path::to_owned).collect();
        fs::create_dir_all(&self.path).map_err(|e| self.refused(&e))?;
        // Where the system cannot lock a folder, runs beside this one are up to the user.
        let lock = File::open(&self.path).ok();
        if let Some(Err(TryLockError::WouldBlock)) = lock.as_ref().map(File::try_lock) {
            return Err(Failure::file(&self.path, "another run of greybox is writing to this folder")
                .help("wait for it to end, or name another folder after `--out`"));
        }
        self.kept.store(true, Ordering::Relaxed);
        for path in waiting(&self.path) {
            // Best effort: nothing reads it.
            let _ = fs::remove_dir_all(path);
        }
        Ok(Kept { _lock: lock, made })
    }

    /// Moves the staged files over those of an existing folder; puts the old ones back when one fails.
    fn replace(&self, stage: &Path, files: &[(&str, &[u8])]) -> io::Result<()> {
        let _held = self.turn();
        let old = stage.join("replaced");
        fs::create_dir(&old)?;
        for (done, (name, _)) in files.iter().enumerate() {
            let (target, kept) = (self.path.join(name), old.join(name));
            let had = target.exists();
            let moved = if had { fs::rename(&target, &kept) } else { Ok(()) }
                .and_then(|()| fs::rename(stage.join(name), &target));
            if let Err(error) = moved {
                for (name, _) in &files[..=done] {
                    // Best effort: the first error is the one to report.
                    let (target, kept) = (self.path.join(name), old.join(name));
                    if kept.exists() {
                        let _ = fs::rename(kept, target);
                    } else if !stage.join(name).exists() {
                        let _ = fs::remove_file(target);
                    }
                }
                return Err(error);
            }
        }
        Ok(())
    }

    /// Where files wait: on the same file system as the folder, so that a rename is enough.
    fn stage(&self) -> PathBuf {
        let near = self.path.ancestors().find(|p| p.is_dir());
        // A relative path ends at "", which is the working directory.
        let near = near.unwrap_or_else(|| match self.path.is_absolute() {
            true => Path::new("/"),
            false => Path::new("."),
        });
        let (head, tail) = WAITING;
        near.join(format!("{head}{}-{}{tail}", std::process::id(), self.number))
    }

    fn refused(&self, error: &io::Error) -> Failure {
        Failure::file(&self.path, format!("the output cannot be written: {error}"))
            .help("name a place after `--out` that you may write to, and see that the disk has room")
    }
}

/// What waits in a folder to be moved, of this run or another.
fn waiting(folder: &Path) -> Vec<PathBuf> {
    let (head, tail) = WAITING;
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let waits = |name: &str| name.starts_with(head) && name.ends_with(tail);
    entries.filter(|entry| entry.file_name().to_str().is_some_and(waits)).map(|entry| entry.path()).collect()
}

/// Takes away what runs that were killed left waiting.
fn sweep(folder: &Path) {
    for path in waiting(folder) {
        let modified = fs::metadata(&path).and_then(|m| m.modified());
        let old = modified.is_ok_and(|time| time.elapsed().is_ok_and(|age| age > FORGOTTEN));
        if old && locked(&path).is_some() {
            // Best effort: nothing reads it.
            let _ = fs::remove_dir_all(path);
        }
    }
}

/// A folder held against other processes until the value is dropped; nothing where another holds it, or where the system
/// cannot lock a folder.
fn locked(folder: &Path) -> Option<File> {
    let file = File::open(folder).ok()?;
    file.try_lock().ok()?;
    Some(file)
}

/// A folder that is kept for this process.
#[derive(Debug)]
pub(crate) struct Kept {
    _lock: Option<File>,
    /// The folders that were made for it, the innermost first.
    made: Vec<PathBuf>,
}

impl Kept {
    /// Takes away again what was made and is still empty.
    pub(crate) fn give_up(self) {
        for folder in self.made {
            // Not empty, or gone: either way it is not ours.
            let _ = fs::remove_dir(folder);
        }
    }
}

/// Sees that what stands at `path`, if anything, may be replaced: a folder or a device may not.
fn ordinary(path: &Path) -> Result<(), Failure> {
    // Asked once: another run may take the file away meanwhile.
    if let Ok(found) = fs::metadata(path)
        && !found.is_file()
    {
        let what = if found.is_dir() { "this is a folder" } else { "this is a device, not an ordinary file" };
        return Err(Failure::file(path, format!("{what}, but the result is one file"))
            .help("name another place after `--out`, such as `simulated.csv`"));
    }
    Ok(())
}

/// A single file of results, as [`OutputFolder`] is a folder of them.
#[derive(Debug)]
pub(crate) struct OutputFile {
    folder: OutputFolder,
    name: String,
}

impl OutputFile {
    /// The file at `path`, which need not exist, nor its folder.
    ///
    /// # Errors
    /// Bad input when `path` is a folder or one of `inputs`, or cannot be written.
    pub(crate) fn prepare(path: &Path, inputs: &[&Path]) -> Result<OutputFile, Failure> {
        ordinary(path)?;
        if let Some(input) = inputs.iter().find(|input| same_file(path, input)) {
            return Err(Failure::file(input, "the result would overwrite this input")
                .help("name another file after `--out`"));
        }
        // A link is followed: its target is replaced, the link stays.
        let resolved = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let path = resolved.as_path();
        let Some(name) = path.file_name().and_then(|n| n.to_str()) else {
            return Err(Failure::file(path, "this is not the name of a file")
                .help("name a file after `--out`, such as `simulated.csv`"));
        };
        let parent = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        Ok(OutputFile { folder: OutputFolder::prepare(parent)?, name: name.to_owned() })
    }

    /// Writes the file whole.
    ///
    /// # Errors
    /// As [`OutputFolder::write`].
    pub(crate) fn write(&self, content: &[u8]) -> Result<(), Failure> {
        self.folder.write(&[(&self.name, content)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(path: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(path).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn makes_the_folder_and_those_above_it() {
        let top = tempfile::tempdir().unwrap();
        let out = top.path().join("a/b/c");
        let folder = OutputFolder::prepare(&out).unwrap();
        assert!(names(top.path()).is_empty(), "preparing leaves no trace");
        folder.write(&[("x", b"1"), ("y", b"2")]).unwrap();
        assert_eq!(names(&out), ["x", "y"]);
        assert_eq!(names(top.path()), ["a"]);
    }

    #[test]
    fn replaces_its_own_files_and_keeps_others() {
        let top = tempfile::tempdir().unwrap();
        fs::write(top.path().join("x"), "old").unwrap();
        fs::write(top.path().join("notes"), "mine").unwrap();
        OutputFolder::prepare(top.path()).unwrap().write(&[("x", b"new"), ("y", b"2")]).unwrap();
        assert_eq!(names(top.path()), ["notes", "x", "y"]);
        assert_eq!(fs::read(top.path().join("x")).unwrap(), b"new");
    }

    #[test]
    fn puts_everything_back_when_one_file_cannot_be_written() {
        let top = tempfile::tempdir().unwrap();
        fs::write(top.path().join("x"), "old").unwrap();
        let folder = OutputFolder::prepare(top.path()).unwrap();
        // The last name needs a folder that is not there.
        let failure = folder.write(&[("w", b"0"), ("x", b"new"), ("no/such", b"2")]).unwrap_err();
        assert!(failure.to_string().contains("cannot be written"), "{failure}");
        assert_eq!(names(top.path()), ["x"]);
        assert_eq!(fs::read(top.path().join("x")).unwrap(), b"old");
    }

    #[test]
    fn a_new_folder_has_folders_inside_or_is_not_there() {
        let top = tempfile::tempdir().unwrap();
        fs::write(top.path().join("data"), "1,2").unwrap();
        let folder = OutputFolder::prepare(&top.path().join("a/case")).unwrap();
        let text = |name: &str| (name.to_owned(), Content::Text("x".into()));
        let copy = |from: &str| ("in/data".to_owned(), Content::Copy(top.path().join(from)));
        folder.write_new(&[text("x"), copy("nowhere")]).unwrap_err();
        assert_eq!(names(top.path()), ["data"]);
        folder.write_new(&[text("x"), copy("data")]).unwrap();
        assert_eq!(names(&top.path().join("a/case")), ["in", "x"]);
        assert_eq!(fs::read(top.path().join("a/case/in/data")).unwrap(), b"1,2");
        folder.write_new(&[text("y")]).unwrap_err();
        assert_eq!(names(&top.path().join("a/case")), ["in", "x"]);
        assert_eq!(names(top.path()), ["a", "data"]);
    }

    /// What a killed run left is taken away; what another run is writing is not.
    #[cfg(unix)]
    #[test]
    fn what_was_left_waiting_goes() {
        let top = tempfile::tempdir().unwrap();
        let [left, held, young] =
            ["1-0", "2-0", "3-0"].map(|n| top.path().join(format!(".greybox-{n}.partial")));
        for path in [&left, &held, &young] {
            fs::create_dir(path).unwrap();
            fs::write(path.join("report.json"), "half").unwrap();
        }
        #[allow(clippy::disallowed_methods, reason = "the age of a file")]
        let past = std::time::SystemTime::now() - 2 * FORGOTTEN;
        for path in [&left, &held] {
            File::open(path).unwrap().set_modified(past).unwrap();
        }
        let _held = locked(&held).unwrap();
        OutputFolder::prepare(top.path()).unwrap().write(&[("x", b"1")]).unwrap();
        assert_eq!(names(top.path()), [".greybox-2-0.partial", ".greybox-3-0.partial", "x"]);
    }

    #[test]
    fn two_runs_into_one_folder_leave_the_files_of_one() {
        let top = tempfile::tempdir().unwrap();
        for round in 0..20 {
            let out = top.path().join(format!("{round}"));
            thread::scope(|scope| {
                for content in ["first", "second", "third"] {
                    let folder = OutputFolder::prepare(&out).unwrap();
                    scope.spawn(move || {
                        let files = ["a", "b", "c", "d"].map(|name| (name, content.as_bytes()));
                        folder.write(&files).unwrap();
                    });
                }
            });
            let read: Vec<String> =
                ["a", "b", "c", "d"].map(|name| fs::read_to_string(out.join(name)).unwrap()).into();
            assert!(read.iter().all(|content| *content == read[0]), "{read:?}");
            assert_eq!(names(&out), ["a", "b", "c", "d"]);
        }
    }

    #[test]
    fn rolls_back_a_replacement_that_stops_half_way() {
        let top = tempfile::tempdir().unwrap();
        fs::write(top.path().join("x"), "old").unwrap();
        let folder = OutputFolder::prepare(top.path()).unwrap();
        let stage = folder.stage();
        fs::create_dir(&stage).unwrap();
        fs::write(stage.join("w"), "0").unwrap();
        fs::write(stage.join("x"), "new").unwrap();
        // `y` was never staged, so the third move fails.
        folder.replace(&stage, &[("w", b""), ("x", b""), ("y", b"")]).unwrap_err();
        fs::remove_dir_all(&stage).unwrap();
        assert_eq!(names(top.path()), ["x"]);
        assert_eq!(fs::read(top.path().join("x")).unwrap(), b"old");
    }

    #[test]
    fn a_folder_that_has_the_name_of_a_result_is_kept() {
        let top = tempfile::tempdir().unwrap();
        fs::create_dir(top.path().join("y")).unwrap();
        fs::write(top.path().join("y/mine"), "1").unwrap();
        let folder = OutputFolder::prepare(top.path()).unwrap();
        let failure = folder.write(&[("x", b"1"), ("y", b"2")]).unwrap_err().to_string();
        assert!(failure.contains("this is a folder"), "{failure}");
        assert_eq!(names(top.path()), ["y"]);
        assert_eq!(fs::read(top.path().join("y/mine")).unwrap(), b"1");
    }

    /// A rename would put an ordinary file in the place of the device.
    #[cfg(unix)]
    #[test]
    fn devices_and_links_stay_what_they_are() {
        let top = tempfile::tempdir().unwrap();
        let socket = top.path().join("socket");
        let _bound = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        let failure = OutputFile::prepare(&socket, &[]).unwrap_err().to_string();
        assert!(failure.contains("this is a device"), "{failure}");
        let (target, link) = (top.path().join("target"), top.path().join("link"));
        fs::write(&target, "old").unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        OutputFile::prepare(&link, &[]).unwrap().write(b"new").unwrap();
        assert!(link.is_symlink());
        assert_eq!(fs::read(&target).unwrap(), b"new");
    }

    #[test]
    fn a_file_in_the_way_is_named() {
        let top = tempfile::tempdir().unwrap();
        let file = top.path().join("f");
        fs::write(&file, "").unwrap();
        let failure = OutputFolder::prepare(&file.join("out")).unwrap_err().to_string();
        assert!(failure.contains("is a file, not a folder"), "{failure}");
        assert!(OutputFolder::prepare(&file).unwrap_err().to_string().contains("need a folder"));
        assert!(OutputFile::prepare(top.path(), &[]).unwrap_err().to_string().contains("is a folder"));
        assert!(OutputFile::prepare(&file, &[&file]).unwrap_err().to_string().contains("overwrite"));
    }
}
