//! From groups and data sets to structures and arrays.
//!
//! Nothing is reserved on the word of the file: what a data set needs counts against the room before it is read, and
//! references are followed to no more objects than the file can hold.

use super::value::{described, number};
use crate::header::{TIMES, seconds};
use crate::variables::{Array, Class, Value, Variable, rows_of};
use ::hdf5_pure::{
    AttrValue, Dataset, Datatype, Error, File, FormatError, Group, Object, ReferenceType,
    VlenStringReadOptions,
};
use std::collections::HashMap;

/// Deepest nesting of groups and cells.
const MAX_DEPTH: usize = 32;

/// Least bytes of an object in a file: the head of its header.
const OBJECT: u64 = 16;

/// Groups in which MATLAB keeps what references lead to, and its objects.
const HIDDEN: [&str; 2] = ["#refs#", "#subsystem#"];

/// Why the bytes are not read.
#[derive(Debug, PartialEq)]
pub(super) enum Fault {
    /// They end too early, or contradict themselves: in which variable, and what was found.
    Damaged { variable: Option<String>, what: String },
    /// Unpacked they need more than the room.
    TooLarge { variable: String },
}

type Attributes = HashMap<String, AttrValue>;

/// All variables of a file whose values may need `room` bytes.
pub(super) fn variables(bytes: Vec<u8>, room: u64) -> Result<Vec<Variable>, Fault> {
    let damaged = |what: String| Fault::Damaged { variable: None, what };
    let length = bytes.len() as u64;
    let file = File::from_bytes(bytes).map_err(|e| damaged(e.to_string()))?;
    let end = file.superblock().eof_address;
    if end > length {
        return Err(damaged(format!("it ends after {length} of {end} bytes")));
    }
    let mut reader = Reader { objects: length / OBJECT, room };
    let fields = reader.members(&file.root(), &Attributes::new(), "", 0)?.0;
    Ok(fields.into_iter().map(|(name, value)| Variable { name, value }).collect())
}

struct Reader {
    /// How many objects may still be looked at.
    objects: u64,
    /// Bytes that values may still need.
    room: u64,
}

/// A member of a group.
struct Member {
    name: String,
    content: Content,
    attributes: Attributes,
}

/// What a member is.
enum Content {
    Value(Value),
    /// What references of no class lead to: a field of MATLAB's arrays of structures.
    Elements(Vec<Value>),
}

type Fields = Vec<(String, Value)>;

/// Fields of an array of structures.
type Elements = Vec<(String, Vec<Value>)>;

impl Reader {
    /// The members of a group; behind them the elements of a field each, where it is an array of structures.
    fn members(
        &mut self,
        group: &Group,
        attributes: &Attributes,
        path: &str,
        depth: usize,
    ) -> Result<(Fields, Elements), Fault> {
        self.visit(path, depth)?;
        let mut members = Vec::new();
        for (name, dataset) in group.iter_datasets().map_err(|e| damaged(path, &e))? {
            let path = joined(path, &name);
            let attributes = dataset.attrs().map_err(|e| damaged(&path, &e))?;
            let content = self.dataset(&dataset, &attributes, &path, depth + 1)?;
            members.push(Member { name, content, attributes });
        }
        for (name, group) in group.iter_groups().map_err(|e| damaged(path, &e))? {
            if !HIDDEN.contains(&name.as_str()) {
                let path = joined(path, &name);
                let content = Content::Value(self.group(&group, &path, depth + 1)?);
                members.push(Member { name, content, attributes: Attributes::new() });
            }
        }
        sort(&mut members, attributes);
        name_time(&mut members);
        let units = members.iter().filter_map(|m| Some((m.name.clone(), vec![Value::Text(vec![unit(m)?])])));
        let units = Value::Structure { count: 1, fields: units.collect() };
        let (mut fields, mut elements) = (Vec::new(), Vec::new());
        for Member { name, content, .. } in members {
            match content {
                Content::Value(value) => fields.push((name, value)),
                Content::Elements(values) => elements.push((name, values)),
            }
        }
        if matches!(&units, Value::Structure { fields, .. } if !fields.is_empty()) {
            fields.push(("units".to_owned(), units));
        }
        Ok((fields, elements))
    }

    fn group(&mut self, group: &Group, path: &str, depth: usize) -> Result<Value, Fault> {
        let attributes = group.attrs().map_err(|e| damaged(path, &e))?;
        if attributes.contains_key("MATLAB_sparse") {
            return Ok(Value::Other("a sparse matrix"));
        }
        match class(&attributes) {
            None | Some("struct") => {}
            Some("function_handle") => return Ok(Value::Other("a function")),
            Some(_) => return Ok(Value::Other("an object")),
        }
        let (mut fields, elements) = self.members(group, &attributes, path, depth)?;
        let count = elements.first().map_or(0, |(_, values)| values.len());
        if fields.is_empty() && count > 0 && elements.iter().all(|(_, values)| values.len() == count) {
            return Ok(Value::Structure { count, fields: elements });
        }
        fields.extend(elements.into_iter().map(|(name, _)| (name, Value::Other("references"))));
        Ok(structure(fields))
    }

    fn dataset(
        &mut self,
        dataset: &Dataset,
        attributes: &Attributes,
        path: &str,
        depth: usize,
    ) -> Result<Content, Fault> {
        // All empty elements of cells may be one object.
        if attributes.contains_key("MATLAB_empty") {
            return Ok(Content::Value(numbers(vec![0, 0], Vec::new(), Class::Double)));
        }
        self.visit(path, depth)?;
        match self.content(dataset, attributes, path, depth) {
            Ok(content) => Ok(content),
            Err(Trouble::Fault(fault)) => Err(fault),
            Err(Trouble::Library(error)) => match unsupported(&error) {
                Some(what) => Ok(Content::Value(Value::Other(what))),
                None => Err(damaged(path, &error)),
            },
        }
    }

    fn content(
        &mut self,
        dataset: &Dataset,
        attributes: &Attributes,
        path: &str,
        depth: usize,
    ) -> Result<Content, Trouble> {
        let class = class(attributes);
        match class {
            Some("function_handle") => return Ok(Content::Value(Value::Other("a function"))),
            _ if attributes.contains_key("MATLAB_object_decode") => {
                return Ok(Content::Value(Value::Other("an object")));
            }
            _ => {}
        }
        let datatype = dataset.datatype()?;
        let shape = self.shape(dataset, path)?;
        let value = match (class, &datatype) {
            (None | Some("cell"), Datatype::Reference { ref_type: ReferenceType::Object, .. }) => {
                let elements = self.elements(dataset, path, depth)?;
                match class {
                    None => return Ok(Content::Elements(elements)),
                    Some(_) => Value::Cells(elements),
                }
            }
            (Some("char"), _) => match number(&datatype).filter(|number| number.is_text_unit()) {
                Some(number) => {
                    let text = number.text(&dataset.read_raw()?);
                    Value::Text(rows_of(&text, shape.last().copied().unwrap_or(1), shape.iter().product()))
                }
                None => Value::Other("texts"),
            },
            (None, Datatype::String { .. }) => Value::Text(dataset.read_string()?),
            (None, Datatype::VariableLength { is_string: true, .. }) => {
                let most = usize::try_from(self.room).unwrap_or(usize::MAX);
                let limits = VlenStringReadOptions::new().with_max_payload_bytes(most);
                let texts = dataset.read_vlen_strings(limits)?;
                self.charge(texts.iter().map(|text| text.len() as u64).sum(), path)?;
                Value::Text(texts)
            }
            (None, Datatype::Compound { members, size }) if described(&datatype) == "records" => {
                let bytes = dataset.read_raw()?;
                let mut fields = Vec::new();
                for member in members {
                    let value = match number(&member.datatype) {
                        Some(number) => {
                            let offset = usize::try_from(member.byte_offset).unwrap_or(usize::MAX);
                            let values = number.read(&bytes, offset, *size as usize);
                            whole(path, values.len(), &shape)?;
                            self.charge(8 * values.len() as u64, path)?;
                            by_rows(&shape, values, number.class())
                        }
                        None => Value::Other(described(&member.datatype)),
                    };
                    fields.push((member.name.clone(), value));
                }
                structure(fields)
            }
            _ => match number(&datatype) {
                Some(number) => {
                    let bytes = dataset.read_raw()?;
                    let stride = datatype.type_size() as usize;
                    let values = number.read(&bytes, 0, stride);
                    whole(path, values.len(), &shape)?;
                    match class {
                        // MATLAB's columns are HDF5's rows.
                        Some(class) => {
                            let class = if class == "logical" { Class::Truth } else { number.class() };
                            numbers(shape.into_iter().rev().collect(), values, class)
                        }
                        None => by_rows(&shape, values, number.class()),
                    }
                }
                None => Value::Other(described(&datatype)),
            },
        };
        Ok(Content::Value(value))
    }

    /// Size of a data set in each direction, once there is room for its values and for what is unpacked at a time.
    fn shape(&mut self, dataset: &Dataset, path: &str) -> Result<Vec<usize>, Trouble> {
        let bytes = |shape: &[u64], each: u64| shape.iter().try_fold(each, |n, &d| n.checked_mul(d));
        let too_large = || Fault::TooLarge { variable: path.to_owned() };
        let size = dataset.element_size()?;
        let shape = dataset.shape()?;
        // In memory numbers are doubles, whatever they are in the file.
        self.charge(bytes(&shape, size.max(8)).ok_or_else(too_large)?, path)?;
        if let Some(chunk) = dataset.chunk_shape()?
            && bytes(&chunk, size).is_none_or(|needed| needed > self.room)
        {
            return Err(too_large().into());
        }
        shape.into_iter().map(|d| usize::try_from(d).map_err(|_| too_large().into())).collect()
    }

    /// What the references of a data set lead to.
    fn elements(&mut self, dataset: &Dataset, path: &str, depth: usize) -> Result<Vec<Value>, Trouble> {
        let mut elements = Vec::new();
        for (k, object) in dataset.dereference()?.into_iter().enumerate() {
            let path = format!("{path}({})", k + 1);
            elements.push(match object {
                Object::Group(group) => self.group(&group, &path, depth + 1)?,
                Object::Dataset(dataset) => {
                    let attributes = dataset.attrs()?;
                    match self.dataset(&dataset, &attributes, &path, depth + 1)? {
                        Content::Value(value) => value,
                        Content::Elements(_) => Value::Other("references"),
                    }
                }
                _ => Value::Other("references"),
            });
        }
        Ok(elements)
    }

    /// Counts an object: no file leads through more of them than it has, unless in a circle.
    fn visit(&mut self, path: &str, depth: usize) -> Result<(), Fault> {
        let wrong = |what: &str| Fault::Damaged { variable: named(path), what: what.to_owned() };
        if depth > MAX_DEPTH {
            return Err(wrong("it is nested too deeply"));
        }
        self.objects = self.objects.checked_sub(1).ok_or_else(|| wrong("its references lead in circles"))?;
        Ok(())
    }

    fn charge(&mut self, bytes: u64, path: &str) -> Result<(), Fault> {
        let left = self.room.checked_sub(bytes);
        self.room = left.ok_or_else(|| Fault::TooLarge { variable: path.to_owned() })?;
        Ok(())
    }
}

/// Why a data set is not read.
enum Trouble {
    Fault(Fault),
    Library(Error),
}

impl From<Fault> for Trouble {
    fn from(fault: Fault) -> Self {
        Trouble::Fault(fault)
    }
}

impl From<Error> for Trouble {
    fn from(error: Error) -> Self {
        Trouble::Library(error)
    }
}

/// What the library does not read in a file that is whole, in words.
fn unsupported(error: &Error) -> Option<&'static str> {
    let Error::Format(error) = error else { return None };
    match error {
        FormatError::UnsupportedFilter(_) => Some("packed with a filter that is not read"),
        FormatError::UnsupportedVirtualLayout | FormatError::UnsupportedExternalStorage => {
            Some("stored in other files")
        }
        FormatError::InvalidLayoutVersion(5) => Some("stored in the layout of HDF5 2.0, which is not read"),
        _ => None,
    }
}

fn damaged(path: &str, error: &Error) -> Fault {
    Fault::Damaged { variable: named(path), what: error.to_string() }
}

fn named(path: &str) -> Option<String> {
    (!path.is_empty()).then(|| path.to_owned())
}

fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

/// Sees that there are as many values as the shape says.
fn whole(path: &str, found: usize, shape: &[usize]) -> Result<(), Fault> {
    match found == shape.iter().product::<usize>() {
        true => Ok(()),
        false => Err(Fault::Damaged {
            variable: named(path),
            what: "it has not as many numbers as its shape says".to_owned(),
        }),
    }
}

fn numbers(dimensions: Vec<usize>, values: Vec<f64>, class: Class) -> Value {
    Value::Numbers(Array { dimensions, values, class })
}

/// The array of numbers that stand row by row.
fn by_rows(shape: &[usize], values: Vec<f64>, class: Class) -> Value {
    Value::Numbers(Array::by_rows(shape, values, class))
}

fn structure(fields: Fields) -> Value {
    Value::Structure {
        count: 1,
        fields: fields.into_iter().map(|(name, value)| (name, vec![value])).collect(),
    }
}

/// The class that MATLAB states.
fn class(attributes: &Attributes) -> Option<&str> {
    attributes.get("MATLAB_class")?.as_str()
}

/// The unit that a data set states.
fn unit(member: &Member) -> Option<String> {
    let stated = member.attributes.get("units").or_else(|| member.attributes.get("unit"))?;
    Some(stated.as_str()?.trim().to_owned()).filter(|unit| !unit.is_empty())
}

/// In the order of MATLAB's structure, else of the names: that of the file may be any.
fn sort(members: &mut [Member], attributes: &Attributes) {
    let order = match attributes.get("MATLAB_fields") {
        Some(AttrValue::VarLenAsciiCharArray(names) | AttrValue::AsciiStringArray(names)) => names.as_slice(),
        _ => &[],
    };
    let place = |m: &Member| order.iter().position(|name| *name == m.name).unwrap_or(order.len());
    members.sort_by(|a, b| (place(a), &a.name).cmp(&(place(b), &b.name)));
}

/// Calls the dimension scale that is a time `time`, where nothing is called so, and several `time_NAME`.
fn name_time(members: &mut [Member]) {
    let text = |m: &Member, name: &str| m.attributes.get(name).and_then(AttrValue::as_str).map(str::to_owned);
    let is_scale = |m: &Member| {
        text(m, "CLASS").as_deref() == Some("DIMENSION_SCALE")
            && (text(m, "NAME").is_some_and(|name| TIMES.contains(&name.as_str()))
                || unit(m).is_some_and(|unit| seconds(Some(&unit)).is_some()))
    };
    if members.iter().any(|m| TIMES.contains(&m.name.as_str())) {
        return;
    }
    let mut scales: Vec<&mut Member> = members.iter_mut().filter(|m| is_scale(m)).collect();
    match scales.as_mut_slice() {
        [scale] => "time".clone_into(&mut scale.name),
        several => several.iter_mut().for_each(|scale| scale.name = format!("time_{}", scale.name)),
    }
}
