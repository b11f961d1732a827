//! What a file of variables holds, whatever its format: arrays, texts, structures and cells.

/// A variable of the workspace.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Variable {
    pub(crate) name: String,
    pub(crate) value: Value,
}

/// What a variable, a field or a cell holds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    Numbers(Array),
    /// One text per row.
    Text(Vec<String>),
    /// An array of structures: name of each field, and its value in every structure.
    Structure {
        count: usize,
        fields: Vec<(String, Vec<Value>)>,
    },
    Cells(Vec<Value>),
    /// Something that holds no samples greybox reads: what it is, in words.
    Other(&'static str),
}

/// Numbers in columns one after the other; there are as many as the dimensions say.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    pub(crate) dimensions: Vec<usize>,
    pub(crate) values: Vec<f64>,
    pub(crate) class: Class,
}

/// What kind of numbers an array holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Class {
    /// Floating-point numbers of 64 bits, and whole ones.
    Double,
    /// Floating-point numbers whose digits end after seven or earlier.
    Single,
    /// Truth values.
    Truth,
}

#[cfg(any(feature = "hdf5", feature = "npz"))]
impl Array {
    /// The array of numbers that stand row by row. Of more than two dimensions the first counts the samples there, and
    /// the last here.
    pub(crate) fn by_rows(shape: &[usize], values: Vec<f64>, class: Class) -> Array {
        match *shape {
            [] => Array { dimensions: vec![1, 1], values, class },
            [n] => Array { dimensions: vec![n, 1], values, class },
            [rows, columns] => {
                let column = |c: usize| values.iter().skip(c).step_by(columns);
                let values = (0..columns).flat_map(column).copied().collect();
                Array { dimensions: vec![rows, columns], values, class }
            }
            _ => Array { dimensions: shape.iter().rev().copied().collect(), values, class },
        }
    }
}

/// The rows of a matrix of characters, which stands column by column, without the blanks at their ends.
pub(crate) fn rows_of(text: &str, rows: usize, count: usize) -> Vec<String> {
    if count == 0 || rows == 0 {
        return Vec::new();
    }
    let characters: Vec<char> = text.chars().collect();
    let row = |r: usize| characters.iter().skip(r).step_by(rows).collect::<String>().trim_end().to_owned();
    (0..rows.min(characters.len())).map(row).collect()
}
