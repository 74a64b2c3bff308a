//! Gaussians to write.

use io::{Gaussians, IoError};
use std::path::Path;

/// Numbers without a pattern, in [-1, 1).
pub(crate) struct Numbers(u64);

impl Numbers {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 40) as f32 / (1_u64 << 23) as f32) - 1.0
    }

    fn array<const N: usize>(&mut self, size: f32) -> [f32; N] {
        [(); N].map(|()| size * self.next())
    }
}

/// A few of them, of the sizes that scenes have.
pub(crate) fn gaussians(n: usize, sh_degree: usize) -> Gaussians {
    let mut numbers = Numbers::new(n as u64 + 7 * sh_degree as u64);
    let width = 3 * (sh_degree + 1).pow(2);
    Gaussians {
        means: (0..n).map(|_| numbers.array(20.0)).collect(),
        quats: (0..n).map(|_| numbers.array(3.0)).collect(),
        log_scales: (0..n)
            .map(|_| numbers.array(3.0).map(|s| s - 4.0))
            .collect(),
        opacity_logits: (0..n).map(|_| 6.0 * numbers.next()).collect(),
        sh: (0..n * width).map(|_| 0.9 * numbers.next()).collect(),
        sh_degree,
    }
}

/// Each kind of number that a file must not hold is refused, with its row and the file, and the file that was there stays.
pub(crate) fn refuses_what_is_no_number(write: impl Fn(&Path, &Gaussians) -> Result<(), IoError>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.file");
    std::fs::write(&path, "older").unwrap();
    type Edit = fn(&mut Gaussians, f32);
    let edits: [(&str, Edit); 5] = [
        ("mean of Gaussian 2", |g, v| g.means[2][1] = v),
        ("rotation of Gaussian 2", |g, v| g.quats[2][3] = v),
        ("scale of Gaussian 2", |g, v| g.log_scales[2][0] = v),
        ("opacity of Gaussian 2", |g, v| g.opacity_logits[2] = v),
        ("colour of Gaussian 2", |g, v| g.sh[2 * 12 + 11] = v),
    ];
    for (what, edit) in edits {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut bad = gaussians(4, 1);
            edit(&mut bad, value);
            let error = write(&path, &bad).unwrap_err();
            let text = error.to_string();
            assert!(matches!(error, IoError::NotANumber { .. }), "{text}");
            assert!(
                text.contains(what) && text.ends_with("scene.file"),
                "{text}"
            );
        }
    }
    let mut uneven = gaussians(4, 1);
    uneven.quats.pop();
    assert!(matches!(
        write(&path, &uneven),
        Err(IoError::Invalid { .. })
    ));
    assert_eq!(std::fs::read(&path).unwrap(), b"older");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

/// Gaussians at the ends of what numbers can be, all of them finite.
pub(crate) fn extreme() -> Gaussians {
    let mut all = gaussians(8, 3);
    all.opacity_logits[0] = f32::MAX;
    all.opacity_logits[1] = f32::MIN;
    all.log_scales[2] = [f32::MAX; 3];
    all.log_scales[3] = [f32::MIN; 3];
    all.quats[4] = [0.0; 4];
    all.quats[5] = [f32::MAX; 4];
    all.sh[6 * 48..7 * 48].fill(f32::MAX);
    all.sh[7 * 48..].fill(f32::MIN);
    all
}

/// Rotation matrices, rows, of unit quaternions (w, x, y, z).
pub(crate) fn rotation([w, x, y, z]: [f32; 4]) -> [[f32; 3]; 3] {
    [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ]
}

/// The largest difference between the ellipsoids' axes of a stored rotation, in axes of these signs, and of a Gaussian's own, as
/// lines: to go the other way along an axis is the same ellipsoid.
pub(crate) fn axes_differ(stored: [f32; 4], own: [f32; 4], up: [f32; 3]) -> f32 {
    let length = own
        .iter()
        .map(|v| f64::from(*v).powi(2))
        .sum::<f64>()
        .sqrt();
    let own = rotation(own.map(|v| (f64::from(v) / length) as f32));
    let stored = rotation(stored);
    let differ = |axis: usize| {
        let difference = |sign: f32| {
            let of = |row: usize| (stored[row][axis] - sign * up[row] * own[row][axis]).abs();
            of(0).max(of(1)).max(of(2))
        };
        difference(1.0).min(difference(-1.0))
    };
    differ(0).max(differ(1)).max(differ(2))
}

pub(crate) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The sign of a coefficient in axes of these signs: by the powers of its polynomial.
pub(crate) fn sh_sign(k: usize, axes: [f32; 3]) -> f32 {
    let polynomials = [
        "", "y", "z", "x", "xy", "yz", "zz", "xz", "xx", "xxy", "xyz", "yzz", "zzz", "xzz", "xxz",
        "xxx",
    ];
    let powers = polynomials[k].bytes();
    powers.map(|c| axes[usize::from(c - b'x')]).product()
}
