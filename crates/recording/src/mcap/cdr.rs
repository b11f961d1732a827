//! Plain numbers and texts in the bytes of a message: CDR (XCDR1) of ROS 2, and the packed bytes of ROS 1.
//!
//! CDR begins with four bytes, of which the second says whether numbers stand with their last byte first. Behind them
//! a number of n bytes begins at a multiple of n, counted from their end; a text is its length with the closing zero
//! (4 bytes), its bytes and the zero. ROS 1 knows no such gaps, and no zero behind a text. (OMG DDS-XTypes 1.3, 7.4.1.)

use super::schema::Primitive;

/// Reads one message from its first byte on.
#[derive(Debug, Clone)]
pub(super) struct Bytes<'a> {
    bytes: &'a [u8],
    at: usize,
    big: bool,
    aligned: bool,
    /// What may still be read, in steps: each costs one, so that no message costs more than its length.
    steps: usize,
}

/// Why a message cannot be read, in words.
pub(super) type Fault = String;

impl<'a> Bytes<'a> {
    /// The body of a message of ROS 2.
    ///
    /// # Errors
    /// A message without the four bytes in front, or in an encoding other than plain CDR.
    pub(super) fn cdr(message: &'a [u8]) -> Result<Bytes<'a>, Fault> {
        let (front, bytes) = message.split_at_checked(4).ok_or_else(ends)?;
        let big = match front[..2] {
            [0, 0] => true,
            [0, 1] => false,
            [a, b] => return Err(format!("it is encoded as {a:02x}{b:02x}, not as plain CDR")),
            _ => return Err(ends()),
        };
        Ok(Bytes { bytes, at: 0, big, aligned: true, steps: steps(bytes) })
    }

    /// A message of ROS 1.
    pub(super) fn packed(bytes: &'a [u8]) -> Bytes<'a> {
        Bytes { bytes, at: 0, big: false, aligned: false, steps: steps(bytes) }
    }

    /// Whether gaps and closing zeros are as in CDR.
    pub(super) fn is_cdr(&self) -> bool {
        self.aligned
    }

    /// Counts a step that reads nothing by itself.
    pub(super) fn step(&mut self) -> Result<(), Fault> {
        self.steps = self.steps.checked_sub(1).ok_or_else(|| "it has more parts than bytes".to_owned())?;
        Ok(())
    }

    fn take(&mut self, n: usize, alignment: usize) -> Result<&'a [u8], Fault> {
        self.step()?;
        let start = if self.aligned { self.at.next_multiple_of(alignment) } else { self.at };
        let end = start.checked_add(n).ok_or_else(ends)?;
        let taken = self.bytes.get(start..end).ok_or_else(ends)?;
        self.at = end;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let mut array: [u8; N] = self.take(N, N)?.try_into().map_err(|_| ends())?;
        if self.big {
            array.reverse();
        }
        Ok(array)
    }

    /// A number of seconds or a length.
    pub(super) fn u32(&mut self) -> Result<u32, Fault> {
        self.array().map(u32::from_le_bytes)
    }

    /// The next number.
    pub(super) fn number(&mut self, primitive: Primitive) -> Result<f64, Fault> {
        Ok(match primitive {
            Primitive::Bool => f64::from(u8::from(self.array::<1>()?[0] != 0)),
            Primitive::I8 => f64::from(i8::from_le_bytes(self.array()?)),
            Primitive::U8 => f64::from(u8::from_le_bytes(self.array()?)),
            Primitive::I16 => f64::from(i16::from_le_bytes(self.array()?)),
            Primitive::U16 => f64::from(u16::from_le_bytes(self.array()?)),
            Primitive::I32 => f64::from(i32::from_le_bytes(self.array()?)),
            Primitive::U32 => f64::from(u32::from_le_bytes(self.array()?)),
            Primitive::I64 => i64::from_le_bytes(self.array()?) as f64,
            Primitive::U64 => u64::from_le_bytes(self.array()?) as f64,
            Primitive::F32 => f64::from(f32::from_le_bytes(self.array()?)),
            Primitive::F64 => f64::from_le_bytes(self.array()?),
        })
    }

    /// The next text.
    pub(super) fn text(&mut self) -> Result<&'a [u8], Fault> {
        let length = self.u32()? as usize;
        let text = self.take(length, 1)?;
        Ok(if self.aligned { text.strip_suffix(&[0]).unwrap_or(text) } else { text })
    }

    /// Leaves out `n` numbers.
    pub(super) fn skip(&mut self, primitive: Primitive, n: usize) -> Result<(), Fault> {
        let size = size(primitive);
        // None at all have no gap before them.
        if n > 0 {
            self.take(n.checked_mul(size).ok_or_else(ends)?, size)?;
        }
        Ok(())
    }

    /// How many parts a sequence has.
    pub(super) fn length(&mut self) -> Result<usize, Fault> {
        Ok(self.u32()? as usize)
    }

    /// Seconds and nanoseconds, in ns.
    pub(super) fn nanoseconds(&mut self) -> Result<i64, Fault> {
        let seconds = i32::from_le_bytes(self.array()?);
        // Those of ROS 1 reach beyond 2038.
        let seconds = if self.aligned { i64::from(seconds) } else { i64::from(seconds.cast_unsigned()) };
        Ok(seconds * 1_000_000_000 + i64::from(self.u32()?))
    }

    /// Seconds and nanoseconds of a duration, in s.
    pub(super) fn duration(&mut self) -> Result<f64, Fault> {
        let seconds = i32::from_le_bytes(self.array()?);
        let rest: [u8; 4] = self.array()?;
        let rest = if self.aligned {
            i64::from(u32::from_le_bytes(rest))
        } else {
            i64::from(i32::from_le_bytes(rest))
        };
        Ok((i64::from(seconds) * 1_000_000_000 + rest) as f64 / 1e9)
    }
}

fn size(primitive: Primitive) -> usize {
    match primitive {
        Primitive::Bool | Primitive::I8 | Primitive::U8 => 1,
        Primitive::I16 | Primitive::U16 => 2,
        Primitive::I32 | Primitive::U32 | Primitive::F32 => 4,
        Primitive::I64 | Primitive::U64 | Primitive::F64 => 8,
    }
}

/// Numbers, texts and messages of no part take a step each; a message around them another one.
fn steps(bytes: &[u8]) -> usize {
    1000 + 4 * bytes.len()
}

fn ends() -> Fault {
    "it ends too early".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use Primitive::{Bool, F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};

    const ALL: [(Primitive, usize); 11] = [
        (Bool, 1),
        (I8, 1),
        (U8, 1),
        (I16, 2),
        (U16, 2),
        (I32, 4),
        (U32, 4),
        (F32, 4),
        (I64, 8),
        (U64, 8),
        (F64, 8),
    ];

    /// A number at every place behind the beginning stands at the next multiple of its size, in both orders of bytes.
    #[test]
    fn numbers_stand_at_multiples_of_their_size() {
        for (primitive, size) in ALL {
            for before in 0..9usize {
                for big in [false, true] {
                    let mut bytes = vec![0, u8::from(!big), 0, 0];
                    bytes.extend(vec![0xee; before.next_multiple_of(size)]);
                    let one = match primitive {
                        F32 => 1.0f32.to_be_bytes().to_vec(),
                        F64 => 1.0f64.to_be_bytes().to_vec(),
                        _ => [vec![0; size - 1], vec![1]].concat(),
                    };
                    bytes.extend(if big { one } else { one.into_iter().rev().collect() });
                    let mut reader = Bytes::cdr(&bytes).unwrap();
                    reader.skip(U8, before).unwrap();
                    assert_eq!(reader.number(primitive), Ok(1.0), "{primitive:?} behind {before}, big {big}");
                    assert!(reader.number(U8).is_err(), "nothing is left");
                }
            }
        }
    }

    #[test]
    fn signs_and_sizes_are_kept() {
        for (primitive, size) in ALL {
            let bytes = [vec![0, 1, 0, 0], vec![0xff; size]].concat();
            let found = Bytes::cdr(&bytes).unwrap().number(primitive).unwrap();
            let wanted = match primitive {
                Bool => 1.0,
                I8 | I16 | I32 | I64 => -1.0,
                U8 => 255.0,
                U16 => 65535.0,
                U32 => 4_294_967_295.0,
                U64 => u64::MAX as f64,
                F32 | F64 => f64::NAN,
            };
            assert!(found == wanted || (found.is_nan() && wanted.is_nan()), "{primitive:?}: {found}");
        }
    }

    #[test]
    fn texts_end_with_a_zero_and_the_next_number_is_aligned() {
        let bytes = [&[0, 1, 0, 0, 3, 0, 0, 0][..], b"ab\0\xee", &7u32.to_le_bytes()].concat();
        let mut reader = Bytes::cdr(&bytes).unwrap();
        assert_eq!(reader.text(), Ok(&b"ab"[..]));
        assert_eq!(reader.u32(), Ok(7));
        let packed = [&[2, 0, 0, 0][..], b"ab", &7u32.to_le_bytes()].concat();
        let mut reader = Bytes::packed(&packed);
        assert_eq!(reader.text(), Ok(&b"ab"[..]));
        assert_eq!(reader.u32(), Ok(7));
    }

    /// An empty sequence of doubles is its length alone: what follows stands right behind it.
    #[test]
    fn an_empty_sequence_has_no_gap_behind_it() {
        let bytes = [&[0, 1, 0, 0][..], &0u32.to_le_bytes(), &9u32.to_le_bytes()].concat();
        let mut reader = Bytes::cdr(&bytes).unwrap();
        let length = reader.length().unwrap();
        reader.skip(F64, length).unwrap();
        assert_eq!(reader.u32(), Ok(9));
    }

    #[test]
    fn times_are_nanoseconds() {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend(1_700_000_000i32.to_le_bytes());
        bytes.extend(123_456_789u32.to_le_bytes());
        bytes.extend((-1i32).to_le_bytes());
        bytes.extend(500_000_000u32.to_le_bytes());
        let mut reader = Bytes::cdr(&bytes).unwrap();
        assert_eq!(reader.nanoseconds(), Ok(1_700_000_000_123_456_789));
        assert_eq!(reader.duration(), Ok(-0.5));
        let packed = [&u32::MAX.to_le_bytes()[..], &5u32.to_le_bytes()].concat();
        assert_eq!(Bytes::packed(&packed).nanoseconds(), Ok(4_294_967_295_000_000_005));
    }

    #[test]
    fn what_cannot_be_read_is_told() {
        assert!(Bytes::cdr(&[0, 1]).unwrap_err().contains("too early"));
        assert!(Bytes::cdr(&[0, 3, 0, 0]).unwrap_err().contains("encoded as 0003"));
        let long = [&[0, 1, 0, 0][..], &u32::MAX.to_le_bytes(), b"ab"].concat();
        assert!(Bytes::cdr(&long).unwrap().text().unwrap_err().contains("too early"));
        let mut none = Bytes::packed(&[]);
        assert!((0..2000).find_map(|_| none.step().err()).unwrap().contains("more parts than bytes"));
    }
}
