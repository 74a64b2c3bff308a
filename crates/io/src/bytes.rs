//! Whole files into memory, and a cursor over them that never reads past the end.

use std::fs;
use std::path::Path;

use crate::IoError;

/// The whole file. Its length is the file's own, not one that a header claims.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, IoError> {
    check_regular(path)?;
    fs::read(path).map_err(|e| IoError::access(path, e))
}

/// Refuses what has no end (`/dev/zero`) or may never begin (a named pipe).
pub(crate) fn check_regular(path: &Path) -> Result<(), IoError> {
    let found = fs::metadata(path).map_err(|e| IoError::access(path, e))?;
    if found.is_file() {
        Ok(())
    } else {
        Err(IoError::malformed(path, "this is no regular file"))
    }
}

/// A cursor over little-endian binary data.
pub(crate) struct Cursor<'a> {
    rest: &'a [u8],
    path: &'a Path,
}

impl<'a> Cursor<'a> {
    pub(crate) fn new(data: &'a [u8], path: &'a Path) -> Self {
        Self { rest: data, path }
    }

    /// The next `count` bytes; `what` is for the message.
    pub(crate) fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8], IoError> {
        if count > self.rest.len() {
            return Err(IoError::truncated(
                self.path,
                format!("{what} needs {count} bytes, {} are left", self.rest.len()),
            ));
        }
        let (head, rest) = self.rest.split_at(count);
        self.rest = rest;
        Ok(head)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], IoError> {
        let bytes = self.take(N, what)?;
        Ok(bytes.try_into().expect("take returns the length asked for"))
    }

    pub(crate) fn u32(&mut self, what: &str) -> Result<u32, IoError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn i32(&mut self, what: &str) -> Result<i32, IoError> {
        Ok(i32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u64(&mut self, what: &str) -> Result<u64, IoError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn f64(&mut self, what: &str) -> Result<f64, IoError> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// A count of things that take at least `item_bytes` (> 0) each, checked against what is left.
    pub(crate) fn count(&mut self, item_bytes: usize, what: &str) -> Result<usize, IoError> {
        let count = self.u64(what)?;
        let room = self.rest.len() / item_bytes;
        usize::try_from(count)
            .ok()
            .filter(|&count| count <= room)
            .ok_or_else(|| {
                IoError::truncated(
                    self.path,
                    format!("promises {count} {what}, there is room for {room}"),
                )
            })
    }

    /// A zero-terminated string.
    pub(crate) fn c_string(&mut self, what: &str) -> Result<String, IoError> {
        let end = self.rest.iter().position(|&b| b == 0).ok_or_else(|| {
            IoError::truncated(self.path, format!("the end of {what} is missing"))
        })?;
        let bytes = self.take(end, what)?;
        self.take(1, what)?;
        String::from_utf8(bytes.to_vec())
            .map_err(|_| IoError::malformed(self.path, format!("{what} is not UTF-8")))
    }
}
