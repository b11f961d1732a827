//! Reading models and recordings, with errors for the usual mistakes.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use greybox_diagnose::library::{self, Library};
use greybox_model::{Model, Problem};
use greybox_recording::{
    CsvBlocks, EXTENSIONS, Location, Recording, RecordingError, Rename, Selection, episodes, parse_episode,
    read_selected,
};

use crate::failure::Failure;
use crate::foreign;

/// A model and the text it was read from.
#[derive(Debug)]
pub struct LoadedModel {
    /// The model.
    pub model: Model,
    /// Its text.
    pub text: String,
    /// Where it was read, as errors name it.
    pub path: PathBuf,
    /// File name without its folder.
    pub file: String,
}

/// Reads the model at `path`.
///
/// # Errors
/// Bad input: no such file, a folder, a recording or the file of another tool in its place, or a fault in the model.
pub fn model(path: &Path) -> Result<LoadedModel, Failure> {
    read_text(path).and_then(|text| model_of(text, path)).map_err(|failure| match foreign::of(path) {
        Some(kind) => kind.as_model(path),
        None if is_recording(&Location::of(path).file) => {
            not_a_model(path, if has_extension(path, "csv") { "a recording (CSV)" } else { "a recording" })
        }
        None => failure,
    })
}

fn is_recording(path: &Path) -> bool {
    path.is_file() && EXTENSIONS.iter().any(|e| has_extension(path, e))
}

/// The error where a recording stands in the place of the model.
fn not_a_model(path: &Path, what: &str) -> Failure {
    Failure::file(path, format!("this is {what}, but a model (TOML) is needed here"))
        .help("put the model first and the recordings after it: `MODEL.toml TRAIN.csv`")
}

/// The model in `text`, which errors say stands at `path`.
///
/// # Errors
/// Bad input: a recording in its place, or a fault in the model.
pub fn model_of(text: String, path: &Path) -> Result<LoadedModel, Failure> {
    let label = path.display().to_string();
    match Model::from_toml(&text, &label) {
        Ok(model) => Ok(LoadedModel { model, file: file_name(path), path: path.to_owned(), text }),
        Err(error)
            if matches!(error.problem(), Problem::Toml { .. }) && looks_like_recording(path, &text) =>
        {
            Err(not_a_model(path, "a recording (CSV)"))
        }
        Err(_) if text.trim().is_empty() => Err(Failure::file(path, "the model file is empty")
            .help("write at least [states], [parameters] and [equations]")),
        Err(error) => Err(Failure::model(&error, &text)),
    }
}

fn read_text(path: &Path) -> Result<String, Failure> {
    if path.is_dir() {
        return Err(Failure::file(path, "this is a folder, not a model").help("name one TOML file inside it"));
    }
    text(path)
}

/// The text of a file.
///
/// # Errors
/// Bad input: no such file, a folder or a device, or a file that is no text.
pub fn text(path: &Path) -> Result<String, Failure> {
    let unread = |e: io::Error| match e.kind() {
        ErrorKind::NotFound => Failure::file(path, "no such file").help("check the path and the spelling"),
        _ => Failure::file(path, format!("the file cannot be read: {e}")).help("check its permissions"),
    };
    let kind = fs::metadata(path).map_err(unread)?.file_type();
    if kind.is_dir() || greybox_recording::is_device(kind) {
        let what = if kind.is_dir() { "folder" } else { "device" };
        return Err(Failure::file(path, format!("this is a {what}, not a file")).help("name a file"));
    }
    let bytes = fs::read(path).map_err(unread)?;
    let line = |at: usize| 1 + bytes[..at].iter().filter(|&&b| b == b'\n').count();
    if let Some(at) = bytes.iter().position(|&b| b == 0) {
        return Err(Failure::file(
            path,
            format!("line {}: the file holds zero bytes, like a binary file", line(at)),
        )
        .help("save it again as UTF-8 text"));
    }
    match std::str::from_utf8(&bytes) {
        Ok(text) => Ok(text.to_owned()),
        Err(e) => {
            Err(Failure::file(path, format!("line {}: the file is not UTF-8 text", line(e.valid_up_to())))
                .help("save it again as UTF-8"))
        }
    }
}

/// The built-in mechanisms and those of a folder.
#[derive(Debug)]
pub struct Mechanisms {
    /// All of them.
    pub library: Library,
    /// The files of the folder.
    pub files: Vec<PathBuf>,
    /// Name and text of each.
    pub texts: Vec<(String, String)>,
}

/// Adds every `*.toml` of the folder, in the order of their names, to the built-in library.
///
/// # Errors
/// Bad input: no such folder, no mechanism in it, or a fault in one.
pub fn mechanisms(folder: &Path) -> Result<Mechanisms, Failure> {
    if folder.is_file() {
        return Err(Failure::file(folder, "this is a file, but `--mechanisms` takes a folder")
            .help("name the folder that holds the mechanism files"));
    }
    let files = files_of(folder, &["toml"])?;
    if files.is_empty() {
        return Err(Failure::file(folder, "this folder holds no mechanism (`*.toml`)")
            .help("`greybox mechanisms --example` prints one to start from"));
    }
    let mut texts = Vec::with_capacity(files.len());
    for path in &files {
        texts.push((file_name(path), read_text(path)?));
    }
    let library = mechanisms_of(&texts, folder)?;
    Ok(Mechanisms { library, files, texts })
}

/// Adds mechanisms, each by name and text, to the built-in library; errors say that they stand in `folder`.
///
/// # Errors
/// Bad input: a fault in one.
pub fn mechanisms_of(texts: &[(String, String)], folder: &Path) -> Result<Library, Failure> {
    library::combine(texts).map_err(|e| Failure::mechanism(&e, texts, folder))
}

/// The recordings of a folder, in the order of their files' names; each episode of a file with several is one.
///
/// # Errors
/// Bad input: as [`files_of`], or no recording in it.
pub fn recordings_of(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let recordings = some_recordings(folder, files_of(folder, &EXTENSIONS)?)?;
    Ok(recordings.into_iter().flat_map(by_episode).collect())
}

/// The recordings in the file at `path`, by their paths: `data.parquet#0`, `data.parquet#1`, …; the path itself where the
/// file is one recording, or cannot be read: that is reported when its turn comes.
pub fn by_episode(path: PathBuf) -> Vec<PathBuf> {
    match episodes(&path) {
        Ok(episodes) if !episodes.is_empty() => {
            let named = |episode: i64| {
                let mut named = path.clone().into_os_string();
                named.push(format!("#{episode}"));
                PathBuf::from(named)
            };
            episodes.into_iter().map(named).collect()
        }
        _ => vec![path],
    }
}

fn some_recordings(folder: &Path, recordings: Vec<PathBuf>) -> Result<Vec<PathBuf>, Failure> {
    if recordings.is_empty() {
        let endings = EXTENSIONS.map(|e| format!("`*.{e}`")).join(", ");
        return Err(Failure::file(folder, format!("this folder holds no recording ({endings})"))
            .help("name the folder that holds the recordings themselves, or the files one by one"));
    }
    Ok(recordings)
}

/// These paths, with the recordings of a folder and of the folders in it in its place: a ROS 2 bag is a folder.
///
/// # Errors
/// As [`recordings_of`].
pub fn without_folders(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut files = Vec::with_capacity(paths.len());
    for path in paths {
        match path.is_dir() {
            true => {
                let mut found = Vec::new();
                for folder in folders_of(path) {
                    found.extend(files_of(&folder, &EXTENSIONS)?);
                }
                files.extend(some_recordings(path, found)?.into_iter().flat_map(by_episode));
            }
            false => files.push(path.clone()),
        }
    }
    Ok(files)
}

/// A folder and all folders in it, in the order of their names; a link to a folder is not followed.
fn folders_of(folder: &Path) -> Vec<PathBuf> {
    let mut folders = vec![folder.to_path_buf()];
    let mut inner: Vec<PathBuf> = fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path())
        .collect();
    inner.sort();
    folders.extend(inner.iter().flat_map(|folder| folders_of(folder)));
    folders
}

/// The files of a folder with one of these extensions, in the order of their names.
///
/// # Errors
/// Bad input: no such folder, or one that cannot be read.
pub fn files_of(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, Failure> {
    let entries = fs::read_dir(folder).map_err(|e| match e.kind() {
        ErrorKind::NotFound => {
            Failure::file(folder, "no such folder").help("check the path and the spelling")
        }
        _ => Failure::file(folder, format!("the folder cannot be read: {e}")).help("check its permissions"),
    })?;
    let mut files: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|e| e.path()))
        .filter(|path| extensions.iter().any(|e| has_extension(path, e)) && path.is_file())
        .collect();
    files.sort();
    Ok(files)
}

fn looks_like_recording(path: &Path, text: &str) -> bool {
    let header = text.lines().next().unwrap_or_default();
    has_extension(path, "csv") || header.starts_with("t,") || header.starts_with("t [")
}

fn looks_like_model(path: &Path) -> bool {
    has_extension(path, "toml")
        || fs::read_to_string(path).is_ok_and(|text| text.lines().any(|line| line.trim() == "[equations]"))
}

fn has_extension(path: &Path, wanted: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(wanted))
}

/// Name of a file without its folder.
pub fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
}

/// Which channels of recordings are read, and what they are called.
#[derive(Debug, Clone, Default)]
pub struct Wanted {
    map: Vec<Rename>,
    selection: Selection,
}

impl Wanted {
    /// The channels called `channels` alone, all if there are none, under the names of `map`.
    pub fn new(map: &[Rename], channels: &[String]) -> Wanted {
        Wanted { map: map.to_vec(), selection: Selection::of(channels, map) }
    }

    /// Of a file with several clocks only what the model names.
    #[must_use]
    pub fn of_model(self, model: &Model) -> Wanted {
        let inputs = model.inputs.iter().map(|input| {
            let base = input.derivative_of().map(str::to_owned);
            std::iter::once(input.channel.clone()).chain(base).collect()
        });
        let measured = model.measurements.iter().map(|measurement| vec![measurement.channel.clone()]);
        self.of_names(inputs.chain(measured))
    }

    /// Of a file with several clocks only these, of each list the first one that is there.
    #[must_use]
    pub fn of_names(mut self, names: impl IntoIterator<Item = Vec<String>>) -> Wanted {
        self.selection = self.selection.with(&self.map, names);
        self
    }

    /// Keeps and renames channels of a recording.
    ///
    /// # Errors
    /// Bad input: a channel that it does not have, or a name that is taken.
    pub fn apply(&self, recording: &mut Recording) -> Result<(), Failure> {
        recording.select(&self.selection)?;
        Ok(recording.rename(&self.map)?)
    }
}

/// Reads the recordings at `paths`, of their channels those that are wanted. Recordings that share a file name are called by
/// their paths.
///
/// # Errors
/// Bad input: a file that is missing, a model or a folder in its place, one named twice, any fault in it, or a channel
/// that is wanted and that it does not have.
pub fn recordings(paths: &[PathBuf], wanted: &Wanted) -> Result<Vec<Recording>, Failure> {
    each_recording(paths, wanted)?.collect()
}

/// Reads recordings when their turn comes, each of which may fail on its own.
///
/// # Errors
/// Bad input: a recording named twice.
pub fn each_recording<'a>(
    paths: &'a [PathBuf],
    wanted: &'a Wanted,
) -> Result<impl Iterator<Item = Result<Recording, Failure>>, Failure> {
    no_twins(paths)?;
    let read = move |path: &'a PathBuf| {
        let mut recording =
            read_selected(path, &wanted.selection).map_err(|error| unreadable(path, error))?;
        recording.name = called(path, paths);
        wanted.apply(&mut recording)?;
        Ok(recording)
    };
    Ok(paths.iter().map(read))
}

/// The bytes of the recording at `path`; of an episode, those of the whole file.
///
/// # Errors
/// Bad input: a file that is missing, or a folder or a device in its place.
pub fn content(path: &Path) -> Result<Vec<u8>, Failure> {
    greybox_recording::content(path).map_err(|error| unreadable(path, error))
}

/// The recording in the bytes of the file at `path`, of its channels those that are wanted. Nothing need stand there: a path may be that
/// of another machine, or a URL.
///
/// # Errors
/// Bad input: any fault in it, or a channel that is wanted and that it does not have.
pub fn recording_of(bytes: Vec<u8>, path: &Path, wanted: &Wanted) -> Result<Recording, Failure> {
    let (label, name) = (path.display().to_string(), file_name(path));
    let episode = Location::of(path).episode;
    let mut recording = parse_episode(bytes, &label, &name, episode.as_deref(), &wanted.selection)
        .map_err(|error| unreadable(path, error))?;
    wanted.apply(&mut recording)?;
    Ok(recording)
}

/// An error where a recording is named twice, or an episode beside the whole file.
///
/// # Errors
/// Bad input: the second of the two.
pub fn no_twins<'a>(paths: impl IntoIterator<Item = &'a PathBuf>) -> Result<(), Failure> {
    let mut seen: BTreeMap<PathBuf, Vec<(Option<String>, &PathBuf)>> = BTreeMap::new();
    for path in paths {
        let Location { file, episode } = Location::of(path);
        let same = seen.entry(fs::canonicalize(&file).unwrap_or(file)).or_default();
        if let Some((_, twin)) = same.iter().find(|(other, _)| overlap(other.as_deref(), episode.as_deref()))
        {
            return Err(Failure::file(
                path,
                format!("this recording is named twice (also as {})", twin.display()),
            )
            .help("name each recording once, either for training or after `--holdout`"));
        }
        same.push((episode, path));
    }
    Ok(())
}

/// Whether two episodes of a file share rows; none stands for the whole file.
fn overlap(a: Option<&str>, b: Option<&str>) -> bool {
    a.zip(b).is_none_or(|(a, b)| a == b)
}

fn unreadable(path: &Path, error: RecordingError) -> Failure {
    if path.is_file() && looks_like_model(path) {
        return Failure::file(path, "this is a model (TOML), but a recording is needed here")
            .help("name the model once, before the recordings");
    }
    match foreign::of(path) {
        Some(kind) => kind.as_recording(path),
        None => error.into(),
    }
}

/// The recordings at `paths` one after the other, in blocks of `rows` rows.
///
/// # Errors
/// As [`recordings`], and for a recording that is no CSV; what is wrong with a block comes in its place.
pub fn blocks(
    paths: &[PathBuf],
    rows: usize,
    wanted: &Wanted,
) -> Result<impl Iterator<Item = Result<Recording, Failure>>, Failure> {
    let open = |path: &PathBuf| {
        let Location { file, episode } = Location::of(path);
        if episode.is_some() || EXTENSIONS.iter().any(|e| *e != "csv" && has_extension(&file, e)) {
            return Err(Failure::file(path, "only CSV files are read in blocks")
                .help("leave `--block` out, or export the recording as CSV"));
        }
        CsvBlocks::open(path, rows).map_err(|error| unreadable(path, error))
    };
    let files = paths.iter().map(open).collect::<Result<Vec<_>, _>>()?;
    Ok(files.into_iter().flatten().map(move |block| {
        let mut block = block?;
        wanted.apply(&mut block)?;
        Ok(block)
    }))
}

/// How the recording at `path` is called among those at `paths`: by its file name, unless another has it too.
pub fn called(path: &Path, paths: &[PathBuf]) -> String {
    let name = file_name(path);
    match paths.iter().any(|other| other != path && file_name(other) == name) {
        true => path.display().to_string(),
        false => name,
    }
}

/// Reads the recordings for training and those held out, and sees that no recording is both.
///
/// # Errors
/// As [`recordings`].
pub fn train_and_holdout(
    train: &[PathBuf],
    holdout: &[PathBuf],
    wanted: &Wanted,
) -> Result<(Vec<Recording>, Vec<Recording>), Failure> {
    let paths: Vec<PathBuf> = train.iter().chain(holdout).cloned().collect();
    let mut train_recordings = recordings(&paths, wanted)?;
    let held = train_recordings.split_off(train.len());
    Ok((train_recordings, held))
}

/// Whether both paths lead to one existing file, and not to different episodes of it.
pub fn same_file(a: &Path, b: &Path) -> bool {
    let (a, b) = (Location::of(a), Location::of(b));
    match (fs::canonicalize(a.file), fs::canonicalize(b.file)) {
        (Ok(one), Ok(other)) => one == other && overlap(a.episode.as_deref(), b.episode.as_deref()),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A model names the columns of its inputs and measurements; of the derivative of an input the one or the other; and what
    /// `--map` gives a name to under the name in the file.
    #[test]
    fn a_model_names_what_is_read() {
        let text = "[inputs]\nf = { unit = \"N\" }\nw = { unit = \"m\" }\ndw = { unit = \"m/s\", channel = \"w'\" }\n\
                    [states]\nx = { unit = \"m\", channel = \"/j.position[a]\" }\n\
                    [parameters]\nm = { value = 1, unit = \"kg\" }\nk = { value = 1, unit = \"N/m\" }\n\
                    b = { value = 1, unit = \"N s/m\" }\n\
                    [equations]\nbody = \"m*x'' + k*(x - w) + b*(x' - dw) = f\"\n";
        let model = Model::from_toml(text, "m.toml").map_err(|e| e.to_string());
        let model = model.unwrap_or_else(|e| panic!("{e}"));
        let map: Vec<Rename> = vec!["f=/cmd.data[N]".parse().unwrap_or_else(|e| panic!("{e}"))];
        let wanted = Wanted::new(&map, &[]).of_model(&model);
        let named: Vec<String> = wanted.selection.named.iter().map(|names| names.join(" or ")).collect();
        assert_eq!(named, ["/cmd.data[N] or /cmd.data", "w", "w' or w", "/j.position[a]"]);
    }
}
