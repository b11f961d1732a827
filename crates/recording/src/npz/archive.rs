//! ZIP archives: their directory, and the content of an entry. Source: PKWARE, APPNOTE.TXT, ZIP File Format Specification.

use super::Fault;
use flate2::Crc;
use flate2::bufread::DeflateDecoder;
use std::borrow::Cow;
use std::io::Read;

/// A file in the archive.
pub(super) struct Entry {
    pub(super) name: String,
    /// 0 = as it is, 8 = deflate.
    method: u16,
    is_encrypted: bool,
    checksum: u32,
    packed: u32,
    size: u32,
    /// Where its own header begins.
    at: u32,
}

const CUT: Fault = Fault::Damaged("the archive ends too early, or its directory leads outside");

/// The entries of the archive's directory.
pub(super) fn entries(bytes: &[u8]) -> Result<Vec<Entry>, Fault> {
    const END: usize = 22;
    /// Most bytes of a comment behind the directory.
    const COMMENT: usize = 1 << 16;
    if !bytes.starts_with(b"PK") {
        return Err(Fault::Format("it is no archive of NumPy"));
    }
    let last = bytes.len().checked_sub(END).ok_or(CUT)?;
    let end = (last.saturating_sub(COMMENT)..=last).rev().find(|&at| bytes[at..].starts_with(b"PK\x05\x06"));
    let mut end = Source { bytes, at: end.ok_or(CUT)? + 10 };
    let (count, _, at) = (end.two()?, end.four()?, end.four()?);
    if at == u32::MAX {
        return Err(Fault::TooLarge);
    }
    let mut source = Source { bytes, at: at as usize };
    (0..count).map(|_| source.entry()).collect()
}

impl Entry {
    /// Its content, which counts against the room.
    pub(super) fn unpacked<'a>(&self, bytes: &'a [u8], room: &mut u64) -> Result<Cow<'a, [u8]>, Fault> {
        if self.is_encrypted {
            return Err(Fault::Format("it is encrypted"));
        }
        // A size of all ones stands elsewhere: it has more than four bytes.
        if self.size == u32::MAX || self.packed == u32::MAX {
            return Err(Fault::TooLarge);
        }
        *room = room.checked_sub(u64::from(self.size)).ok_or(Fault::TooLarge)?;
        let mut header = Source { bytes, at: self.at as usize };
        if header.take(4)? != b"PK\x03\x04" {
            return Err(Fault::Damaged("its directory leads to something else"));
        }
        header.take(22)?;
        let (name, extra) = (header.two()?, header.two()?);
        header.take(usize::from(name) + usize::from(extra))?;
        let packed = header.take(self.packed as usize)?;
        let content = match self.method {
            0 => Cow::Borrowed(packed),
            8 => {
                let mut content = Vec::new();
                let mut decoder = DeflateDecoder::new(packed).take(u64::from(self.size) + 1);
                let read = decoder.read_to_end(&mut content);
                read.map_err(|_| Fault::Damaged("what is compressed there cannot be unpacked"))?;
                Cow::Owned(content)
            }
            _ => return Err(Fault::Format("it is packed by another method than deflate")),
        };
        let mut checksum = Crc::new();
        checksum.update(&content);
        if content.len() != self.size as usize || checksum.sum() != self.checksum {
            return Err(Fault::Damaged("its size or checksum is not the stated one"));
        }
        Ok(content)
    }
}

/// Bytes that are read from front to back.
struct Source<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Source<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8], Fault> {
        let taken = self.bytes.get(self.at..).and_then(|rest| rest.get(..length)).ok_or(CUT)?;
        self.at += length;
        Ok(taken)
    }

    fn two(&mut self) -> Result<u16, Fault> {
        Ok(self.take(2)?.iter().rev().fold(0, |number, &byte| number << 8 | u16::from(byte)))
    }

    fn four(&mut self) -> Result<u32, Fault> {
        Ok(self.take(4)?.iter().rev().fold(0, |number, &byte| number << 8 | u32::from(byte)))
    }

    fn entry(&mut self) -> Result<Entry, Fault> {
        if self.take(4)? != b"PK\x01\x02" {
            return Err(Fault::Damaged("the directory of the archive cannot be read"));
        }
        self.take(4)?;
        let (flags, method) = (self.two()?, self.two()?);
        self.take(4)?;
        let (checksum, packed, size) = (self.four()?, self.four()?, self.four()?);
        let (name, extra, comment) = (self.two()?, self.two()?, self.two()?);
        self.take(8)?;
        let at = self.four()?;
        let name = String::from_utf8_lossy(self.take(usize::from(name))?).into_owned();
        self.take(usize::from(extra) + usize::from(comment))?;
        Ok(Entry { name, method, is_encrypted: flags & 1 == 1, checksum, packed, size, at })
    }
}
