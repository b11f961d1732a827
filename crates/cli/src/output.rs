//! Writing results whole or not at all.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

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
}

/// How many folders this process has made.
static FOLDERS: AtomicUsize = AtomicUsize::new(0);

/// Name of the files that wait: head, number of the process, number of the folder, tail.
const WAITING: (&str, &str) = (".greybox-", ".partial");

impl OutputFolder {
    /// The folder at `path`, which need not exist.
    ///
    /// # Errors
    /// Bad input when `path` or something above it is a file, or the folder cannot be written.
    pub(crate) fn prepare(path: &Path) -> Result<OutputFolder, Failure> {
        let folder = OutputFolder { path: path.to_owned(), number: FOLDERS.fetch_add(1, Ordering::Relaxed) };
        if path.as_os_str().is_empty() {
            return Err(
                Failure::input("the output folder has no name").mend("give one, such as `--out result`")
            );
        }
        if path.is_file() {
            return Err(Failure::file(path, "this is a file, but the results need a folder")
                .mend("name another folder after `--out`, or move the file away"));
        }
        if let Some(file) = path.ancestors().skip(1).find(|p| p.is_file()) {
            return Err(Failure::file(path, format!("`{}` is a file, not a folder", file.display()))
                .mend("name another path after `--out`"));
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
                    .mend("name another folder after `--out`"));
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
                    .mend("name another folder after `--out`"));
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
        let stage = self.stage();
        let result = fs::create_dir(&stage).and_then(|()| {
            for (name, content) in files {
                fs::write(stage.join(name), content)?;
            }
            if self.path.is_dir() {
                return self.replace(&stage, files);
            }
            if let Some(parent) = self.path.parent() {
                fs::create_dir_all(parent)?;
            }
            fs::rename(&stage, &self.path)
        });
        // Gone already where it became the folder itself.
        let _ = fs::remove_dir_all(&stage);
        result.map_err(|e| self.refused(&e))
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
                .mend("wait for it to end, or name another folder after `--out`"));
        }
        let (head, tail) = WAITING;
        for entry in fs::read_dir(&self.path).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if name.to_str().is_some_and(|n| n.starts_with(head) && n.ends_with(tail)) {
                // Best effort: nothing reads it.
                let _ = fs::remove_dir_all(entry.path());
            }
        }
        Ok(Kept { _lock: lock, made })
    }

    /// Moves the staged files over those of an existing folder; puts the old ones back when one fails.
    fn replace(&self, stage: &Path, files: &[(&str, &[u8])]) -> io::Result<()> {
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
            .mend("name a place after `--out` that you may write to, and see that the disk has room")
    }
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
    if path.exists() && !path.is_file() {
        let what = if path.is_dir() { "this is a folder" } else { "this is a device, not an ordinary file" };
        return Err(Failure::file(path, format!("{what}, but the result is one file"))
            .mend("name another place after `--out`, such as `simulated.csv`"));
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
                .mend("name another file after `--out`"));
        }
        // A link is followed: its target is replaced, the link stays.
        let resolved = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let path = resolved.as_path();
        let Some(name) = path.file_name().and_then(|n| n.to_str()) else {
            return Err(Failure::file(path, "this is not the name of a file")
                .mend("name a file after `--out`, such as `simulated.csv`"));
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
