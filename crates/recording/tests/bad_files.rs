//! Every way a file can be wrong: the error names the place, what was found, and the fix.

// Helpers of a test file are tests too; the lint configuration knows only the annotated functions.

use greybox_recording::{Channel, RecordingError, parse_csv, read_csv, write_csv, write_csv_file};

/// Ten good rows after `head`, with the given rows (0 = first under the header) replaced.
fn file(head: &str, replaced: &[(usize, &str)]) -> String {
    let mut rows: Vec<String> = (0..10).map(|k| format!("0.{k},{k},{}", k * k)).collect();
    for &(k, row) in replaced {
        rows[k] = row.to_owned();
    }
    format!("{head}\n{}\n", rows.join("\n"))
}

fn error(text: impl AsRef<[u8]>) -> String {
    parse_csv(text.as_ref(), "bad.csv").expect_err("the file is bad").to_string()
}

#[test]
fn bad_text_is_refused_with_place_and_help() {
    let good = "t,u [V],y [m]";
    let table: Vec<(String, &[&str])> = vec![
        (String::new(), &["bad.csv: the file is empty", "header row"]),
        ("\n\n  \n".into(), &["bad.csv: the file is empty"]),
        ("\u{feff}".into(), &["the file is empty"]),
        (format!("{good}\n"), &["0 rows", "header and nothing under it"]),
        (file(good, &[]).lines().take(6).collect::<Vec<_>>().join("\n"), &["5 rows", "at least 8"]),
        (
            file("t;u;y", &[]).replace(',', ";"),
            &["bad.csv:1: ", "semicolons", "replace the separators by commas"],
        ),
        ("t;u [V]\n0,0;1,5\n0,1;1,6\n".into(), &["semicolons", "decimal commas"]),
        (file(good, &[]).replace(',', "\t"), &["bad.csv:1: ", "tabs"]),
        (file(good, &[(3, "0,3,3,1,9,0")]), &["bad.csv:5: ", "decimal comma", "0,3,3,1,9,0"]),
        (file(good, &[(3, "0.3,\"3,1\",9")]), &["bad.csv:5:u (column 2)", "`3,1`", "decimal point"]),
        (
            file(good, &[(3, "0.3,NaN,9")]),
            &["bad.csv:5:u (column 2)", "`NaN`", "leave the cell empty for a missing sample"],
        ),
        (file(good, &[(3, "0.3,3,-inf")]), &["bad.csv:5:y (column 3)", "`-inf`", "leave the cell empty"]),
        (file(good, &[(3, "0.3,3,1e999")]), &["bad.csv:5:y", "`1e999`"]),
        (file(good, &[(3, "nan,3,9")]), &["bad.csv:5:t (column 1)", "`nan`"]),
        (
            file(good, &[(3, "0.3,n/a,9")]),
            &["bad.csv:5:u (column 2)", "`n/a` is not a number", "leave the cell empty"],
        ),
        (file(good, &[(3, "10:31:02,3,9")]), &["bad.csv:5:t (column 1)", "`10:31:02`", "number of seconds"]),
        (file(good, &[(3, "0.3,3")]), &["bad.csv:5: ", "2 cells", "header has 3"]),
        (file(good, &[(3, "0.3,3,9,")]), &["bad.csv:5: ", "4 cells"]),
        (file(good, &[(3, "0.3,3,\"9\n0.4,4,16")]), &["bad.csv:5:y", "quotation mark"]),
        (file(good, &[(3, ",3,9")]), &["bad.csv:5:t (column 1)", "time is missing"]),
        (file(good, &[(3, ",,")]), &["bad.csv:5:t (column 1)", "time is missing"]),
        (
            file(good, &[(3, "0.2,3,9")]),
            &["bad.csv:5:t (column 1)", "0.2 s does not come after the time 0.2 s", "repeated row"],
        ),
        (
            file(good, &[(3, "0.1,3,9")]),
            &["bad.csv:5:t (column 1)", "0.1 s does not come after", "split the file"],
        ),
        (file("t,u,u [V]", &[]), &["bad.csv:1:u (column 3)", "already stands in column 2", "rename"]),
        (file("t,u,t", &[]), &["bad.csv:1:t (column 3)", "already stands in column 1"]),
        (file("u,t,y", &[]), &["bad.csv:1: ", "found `u`", "move column 2"]),
        (file("time,u,y", &[]), &["found `time`", "rename the time column to `t`"]),
        (file("t [min],u,y", &[]), &["found `t [min]`", "convert the times from min to s"]),
        (file("t,,y", &[]), &["bad.csv:1 (column 2)", "give the column a name"]),
        (file("t,u [V,y", &[]), &["bad.csv:1:u [V (column 2)", "close the unit's bracket"]),
        (file("t,u V],y", &[]), &["open the unit's bracket"]),
        // Found by the fuzzer: it could be read, and not be read again.
        (file("t,u] [],y", &[]), &["open the unit's bracket"]),
        (file("0.0,1,2", &[]), &["bad.csv:1: ", "header row is missing", "`t,u [V],y [m]`"]),
        ("t\n0\n1\n".into(), &["no column beside the time"]),
    ];
    for (text, fragments) in table {
        let message = error(&text);
        for fragment in fragments {
            assert!(message.contains(fragment), "expected `{fragment}` in: {message}\nfor:\n{text}");
        }
        assert!(!message.contains('\n'), "one paragraph: {message}");
    }
}

#[test]
fn bytes_that_are_not_text_are_refused() {
    let mut latin = file("t,u,y", &[]).into_bytes();
    let at = latin.windows(3).position(|w| w == b"0.2").unwrap();
    latin[at + 4] = 0xb0;
    assert!(error(&latin).contains("bad.csv:4: the file is not UTF-8"), "{}", error(&latin));
    let wide: Vec<u8> = [0xff, 0xfe].into_iter().chain("t,y".bytes().flat_map(|b| [b, 0])).collect();
    assert!(error(&wide).contains("UTF-16"));
    assert!(error(b"t,y\n\0\0\0").contains("binary"));
}

#[test]
fn paths_that_are_no_file_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let message = read_csv(folder.path()).unwrap_err().to_string();
    assert!(message.contains("folder") && message.contains("name one CSV file"), "{message}");
    let message = read_csv(folder.path().join("none.csv")).unwrap_err().to_string();
    assert!(message.contains("none.csv: no such file"), "{message}");
}

#[test]
fn harmless_oddities_are_read() {
    let plain = parse_csv(file("t,u [V],y [m]", &[(4, "0.4,,16")]).as_bytes(), "a.csv").unwrap();
    assert_eq!(plain.channels[0].header(), "u [V]");
    assert!(plain.channels[0].values[4].is_nan() && plain.pieces[0].columns[0][4].is_nan());
    let odd = format!(
        "\u{feff}{}\r\n\r\n ,,\r\n",
        file("\"t [s]\",\"u  [V]\",y [ m ]", &[(4, "0.4, ,\"16\"")]).trim_end().replace('\n', "\r\n")
    );
    let odd = parse_csv(odd.as_bytes(), "a.csv").unwrap();
    assert_eq!(odd.time, plain.time);
    assert_eq!(odd.channels[1], plain.channels[1]);
    let header: Vec<_> = odd.channels.iter().map(|c| (c.name.as_str(), c.unit.as_deref())).collect();
    assert_eq!(header, [("u", Some("V")), ("y", Some("m"))]);
    let milliseconds = parse_csv(file("t [ms],u,y", &[]).as_bytes(), "a.csv").unwrap();
    assert!((milliseconds.dt() - 1e-4).abs() < 1e-15 && milliseconds.channels[0].unit.is_none());
}

#[test]
fn what_is_written_reads_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.csv");
    let time: Vec<f64> = (0..50).map(|k| f64::from(k) / 750.0).collect();
    let mut y: Vec<f64> = time.iter().map(|t| 1e-9 * (70.0 * t).sin()).collect();
    y[7] = f64::NAN;
    write_csv_file(&path, &time, &[("y [m]", &y), ("a, b", &time)]).unwrap();
    let back = read_csv(&path).unwrap();
    assert_eq!((back.name.as_str(), &back.time), ("out.csv", &time));
    for (a, b) in back.channels[0].values.iter().zip(&y) {
        assert_eq!(a.to_bits(), b.to_bits());
    }
    assert_eq!(back.channels[1].name, "a, b");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file stays behind");
    // A bracket may end a name, with a unit and without.
    for unit in [Some("rad"), None] {
        let name = "/joint_states.position[elbow]".to_owned();
        let joint = Channel { name, unit: unit.map(str::to_owned), values: y.clone() };
        let path = folder.path().join("joint.csv");
        write_csv_file(&path, &time, &[(&joint.header(), &y)]).unwrap();
        let back = read_csv(&path).unwrap();
        assert_eq!((&back.channels[0].name, &back.channels[0].unit), (&joint.name, &joint.unit));
    }
}

#[test]
fn what_cannot_be_written_is_refused_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.csv");
    let infinite = write_csv_file(&path, &[0.0, 1.0], &[("y", &[1.0, f64::INFINITY])]).unwrap_err();
    assert!(infinite.to_string().contains(":3:y (column 2): `inf`"), "{infinite}");
    let short = write_csv(Vec::new(), &[0.0, 1.0], &[("y", &[1.0])]).unwrap_err();
    assert!(matches!(short, RecordingError::ColumnLength { found: 1, expected: 2, .. }), "{short}");
    assert!(write_csv_file(folder.path().join("no/such/out.csv"), &[0.0], &[]).is_err());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
