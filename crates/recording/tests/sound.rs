//! What must hold of a recording, whatever bytes it was read from: for the tests, and for the fuzz targets (`fuzz/`).

use greybox_recording::{MIN_SAMPLES, Recording, RecordingError, Selection, parse};

/// Bytes as a file of this name, whose ending says the format: a recording is sound, with no more rows than `most` where
/// the length of the file bounds them, and an error names the file.
pub(crate) fn read(name: &str, bytes: &[u8], most: Option<usize>) -> Result<Recording, RecordingError> {
    let read = parse(bytes.to_vec(), name, name, &Selection::default());
    match &read {
        Ok(recording) => sound(recording, most),
        Err(error) => assert!(error.to_string().starts_with(name), "the file is not named: {error}"),
    }
    read
}

/// Pieces are uniform, as long as they say, and together no longer than the rows can ask for.
pub(crate) fn sound(recording: &Recording, most: Option<usize>) {
    let rows = recording.time.len();
    assert!(rows >= MIN_SAMPLES && most.is_none_or(|most| rows <= most), "{rows} rows");
    assert!(recording.channels.iter().all(|c| c.values.len() == rows && !c.name.is_empty()));
    assert!(recording.time.windows(2).all(|w| w[0] < w[1]));
    assert!(!recording.pieces.is_empty());
    let mut samples = 0;
    for piece in &recording.pieces {
        assert!(piece.dt > 0.0 && piece.dt.is_finite(), "a step of {}", piece.dt);
        assert!(piece.len >= MIN_SAMPLES);
        assert!(piece.columns.len() == recording.channels.len());
        assert!(piece.columns.iter().all(|column| column.len() == piece.len));
        samples += piece.len;
    }
    assert!(samples <= 64 * rows, "{rows} rows become {samples} samples");
}
