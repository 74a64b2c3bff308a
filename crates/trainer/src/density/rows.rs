//! Edits of the set of rows, and how parameters follow them.

use crate::tensors::leaf;
use burn::tensor::{Int, Tensor, TensorData};

/// Where a row of the edited set comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowKind {
    /// An old row that stays: it keeps its moments.
    Kept,
    /// A copy of an old row that stays too.
    Clone,
    /// One of the children of an old row that goes.
    SplitChild,
}

/// A change of the set of rows. New row i is made from old row `source[i]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowEdit {
    /// Old row of each new one, [N'].
    pub source: Vec<u32>,
    /// What became of it, [N'].
    pub kind: Vec<RowKind>,
    /// Dynamic Gaussians afterwards: rows [0, `num_dynamic`).
    pub num_dynamic: usize,
}

impl RowEdit {
    /// Number of rows afterwards.
    #[must_use]
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Whether no row is left.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }

    /// Whether the edit leaves `rows` rows as they were.
    #[must_use]
    pub fn is_identity(&self, rows: usize) -> bool {
        self.len() == rows
            && self.kind.iter().all(|kind| *kind == RowKind::Kept)
            && self
                .source
                .iter()
                .enumerate()
                .all(|(new, old)| new == *old as usize)
    }

    /// The edit of what only dynamic Gaussians have (their motion coefficients).
    #[must_use]
    pub fn dynamic(&self) -> Self {
        Self {
            source: self.source[..self.num_dynamic].to_vec(),
            kind: self.kind[..self.num_dynamic].to_vec(),
            num_dynamic: self.num_dynamic,
        }
    }

    /// All of `rows` rows stay, and copies of the dynamic rows `sources` come behind the last dynamic one.
    ///
    /// # Panics
    /// Panics if a source is not a dynamic row, or if there are more dynamic rows than rows.
    #[must_use]
    pub fn append_dynamic(rows: usize, num_dynamic: usize, sources: &[u32]) -> Self {
        assert!(num_dynamic <= rows, "dynamic rows are rows");
        assert!(
            sources
                .iter()
                .all(|source| (*source as usize) < num_dynamic),
            "a dynamic row is copied from a dynamic one"
        );
        let mut edit = Builder::default();
        for row in 0..num_dynamic {
            edit.push(row, RowKind::Kept);
        }
        for source in sources {
            edit.push(*source as usize, RowKind::Clone);
        }
        let dynamic = edit.len();
        for row in num_dynamic..rows {
            edit.push(row, RowKind::Kept);
        }
        edit.finish(dynamic)
    }
}

#[derive(Default)]
pub(super) struct Builder {
    source: Vec<u32>,
    kind: Vec<RowKind>,
}

impl Builder {
    pub(super) fn len(&self) -> usize {
        self.source.len()
    }

    pub(super) fn push(&mut self, row: usize, kind: RowKind) {
        self.source
            .push(u32::try_from(row).expect("fewer than 2^32 Gaussians"));
        self.kind.push(kind);
    }

    pub(super) fn finish(self, num_dynamic: usize) -> RowEdit {
        RowEdit {
            source: self.source,
            kind: self.kind,
            num_dynamic,
        }
    }
}

/// The new rows of a parameter [N, C], [N', C]: a new leaf that requires its gradient if `tensor` is on an autodiff device.
///
/// # Panics
/// Panics if the edit names a row that the tensor does not have.
#[must_use]
pub fn gather_rows(tensor: &Tensor<2>, edit: &RowEdit) -> Tensor<2> {
    let rows = tensor.dims()[0];
    assert!(
        edit.source.iter().all(|source| (*source as usize) < rows),
        "the edit was planned for as many rows as the tensor has"
    );
    let source: Vec<i64> = edit.source.iter().map(|row| i64::from(*row)).collect();
    let autodiff = tensor.is_autodiff();
    let inner = tensor.clone().inner();
    let source =
        Tensor::<1, Int>::from_data(TensorData::new(source, [edit.len()]), &inner.device());
    leaf(inner.select(0, source), autodiff)
}

/// `tensor` [N, C] plus `offsets`, row-major and as many: a new leaf that requires its gradient if `tensor` is on
/// an autodiff device.
///
/// # Panics
/// Panics if the number of offsets is not the tensor's.
#[must_use]
pub fn add_to_rows(tensor: &Tensor<2>, offsets: Vec<f32>) -> Tensor<2> {
    let autodiff = tensor.is_autodiff();
    let inner = tensor.clone().inner();
    let offsets = Tensor::from_data(
        TensorData::new(offsets, inner.dims()),
        (&inner.device(), inner.dtype()),
    );
    leaf(inner + offsets, autodiff)
}
