//! A file read in blocks says what the file read whole says, faults included.

use greybox_recording::{CsvBlocks, Recording, RecordingError, read_csv};

fn file(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("r.csv");
    std::fs::write(&path, text).unwrap();
    (folder, path)
}

/// `rows` rows under a header, the row of number `odd` (from 0) replaced.
fn text(rows: usize, odd: Option<(usize, &str)>) -> String {
    let row = |k: usize| match odd {
        Some((at, row)) if at == k => row.to_owned(),
        _ => format!("{:.2},{k}", 0.01 * k as f64),
    };
    let rows: Vec<String> = (0..rows).map(row).collect();
    format!("t,x [mm]\r\n{}\n", rows.join("\n"))
}

fn blocks(text: &str, rows: usize) -> Result<Vec<Recording>, RecordingError> {
    let (_folder, path) = file(text);
    CsvBlocks::open(&path, rows)?.collect()
}

#[test]
fn the_blocks_are_the_file() {
    let text = text(95, None);
    let (_folder, path) = file(&text);
    let whole = read_csv(&path).unwrap();
    for (rows, lengths) in
        [(20, vec![20, 20, 20, 20, 15]), (24, vec![24, 24, 24, 23]), (30, vec![30, 30, 35]), (500, vec![95])]
    {
        let blocks = blocks(&text, rows).unwrap();
        let found: Vec<usize> = blocks.iter().map(|b| b.time.len()).collect();
        assert_eq!(found, lengths, "{rows}");
        let of =
            |values: fn(&Recording) -> &[f64]| blocks.iter().flat_map(values).copied().collect::<Vec<_>>();
        assert_eq!(of(|b| &b.time), whole.time);
        assert_eq!(of(|b| &b.channels[0].values), whole.channels[0].values);
        assert!(blocks.iter().all(|b| b.channels[0].unit.as_deref() == Some("mm") && b.name == "r.csv"));
    }
}

#[test]
fn a_fault_has_the_line_of_the_file() {
    for rows in [10, 40, 100] {
        let error = |odd: (usize, &str)| blocks(&text(95, Some(odd)), rows).unwrap_err().to_string();
        // Row 63 stands in line 65: the header is line 1.
        assert!(error((63, "0.63,oops")).contains(":65:"), "{rows}: {}", error((63, "0.63,oops")));
        // Time goes back to where a block begins, and within one.
        for at in [40, 47] {
            let error = error((at, "0.11,7"));
            assert!(error.contains(&format!(":{}:", at + 2)), "{rows}: {error}");
        }
    }
}

#[test]
fn what_holds_no_block_is_told() {
    assert!(matches!(blocks("", 10), Err(RecordingError::Empty { .. })));
    assert!(matches!(blocks("\n\n", 10), Err(RecordingError::Empty { .. })));
    assert!(matches!(blocks("t,x\n", 10), Err(RecordingError::TooFewRows { .. })));
    assert!(matches!(CsvBlocks::open("no_such_file.csv", 10), Err(RecordingError::NotFound { .. })));
    // Lines above the header belong to it.
    let late = blocks(&format!("\n\n{}", text(30, Some((20, "0.2,oops")))), 10).unwrap_err().to_string();
    assert!(late.contains(":24:"), "{late}");
    // After an error there is nothing.
    let (_folder, path) = file(&text(30, Some((5, "0.05,oops"))));
    let mut blocks = CsvBlocks::open(path, 10).unwrap();
    assert!(blocks.next().unwrap().is_err() && blocks.next().is_none());
}
