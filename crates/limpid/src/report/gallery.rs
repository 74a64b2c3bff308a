//! The pictures of a report: for every view what was filmed, what the model says the camera saw, the sharp render and the truth, as
//! JPEG, and how the view was blurred.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use io::{Image, encode_jpeg, shrink_image};
use serde::Serialize;
use trainer::{CameraView, KernelView, Spot, TakenView, TrainingView, ViewBlur};

/// Pixels of all pictures together, over which they are made smaller: some five megabytes.
const MOST_PIXELS: usize = 40_000_000;
/// Of the pictures: fine detail is what they are looked at for.
const QUALITY: u8 = 90;
/// Of the light of a point so many places are shown at most.
const MOST_PLACES: usize = 150;
/// Kernels are kept for at most so many places along a side of a frame…
const MOST_PLACES_ALONG: usize = 24;
/// … and, where these would be more, for so many bytes in a report, but never for fewer than so many places along the longer side.
const MOST_KERNEL_BYTES: usize = 4_000_000;
const LEAST_PLACES_ALONG: usize = 4;

/// All pictures, in the order of the views: training frames, then test views.
#[derive(Debug, Serialize)]
pub(crate) struct Gallery {
    /// Pictures are so many times smaller than the frames.
    factor: usize,
    views: Vec<GalleryView>,
    /// For the kernels of a frame.
    #[serde(skip)]
    kernel_bytes: usize,
}

/// A view's pictures as JPEG in base64. What there is not, is absent.
#[derive(Debug, Default, Serialize)]
struct GalleryView {
    /// What was filmed, blurry.
    #[serde(skip_serializing_if = "Option::is_none")]
    input: Option<String>,
    /// What the model says the camera saw.
    #[serde(skip_serializing_if = "Option::is_none")]
    seen: Option<String>,
    /// The sharp render.
    #[serde(skip_serializing_if = "Option::is_none")]
    sharp: Option<String>,
    /// What a sharp camera saw.
    #[serde(skip_serializing_if = "Option::is_none")]
    truth: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<CameraDeed>,
    #[serde(skip_serializing_if = "Option::is_none")]
    kernels: Option<KernelGrid>,
}

/// What the camera did.
#[derive(Debug, Serialize)]
struct CameraDeed {
    /// Length of the path at the depth S, px.
    path_px: f64,
    /// Diameter of the largest disc, px.
    disc_px: f64,
    /// Depth in focus, scene units.
    focus: f64,
    spots: Vec<SpotPlaces>,
}

/// What a point becomes.
#[derive(Debug, Serialize)]
struct SpotPlaces {
    /// Scene units.
    depth: f64,
    /// Where its light falls, px: x, y.
    places: Vec<[f32; 2]>,
}

/// Kernels at places of a grid over the frame.
#[derive(Debug, Serialize)]
struct KernelGrid {
    /// Side K, px.
    size: usize,
    columns: usize,
    rows: usize,
    /// Blur intensities at the places in 255ths, base64 of [rows, columns].
    intensity: String,
    /// Weights in 255ths of the kernel's largest, base64 of [rows, columns, K²].
    weights: String,
}

impl Gallery {
    /// For these views.
    pub(crate) fn new(train: &[CameraView], test: &[CameraView]) -> Self {
        let pixels =
            |views: &[CameraView]| views.iter().map(|v| v.camera.num_pixels()).sum::<usize>();
        let total = 4 * pixels(train) + 2 * pixels(test);
        let factor = (1..).find(|f| total / (f * f) <= MOST_PIXELS).unwrap_or(1);
        Self {
            factor,
            views: Vec::new(),
            kernel_bytes: MOST_KERNEL_BYTES / train.len().max(1),
        }
    }

    /// Adds a training frame.
    pub(crate) fn add_frame(
        &mut self,
        input: Option<&Image>,
        view: &TrainingView,
        truth: Option<&Image>,
    ) {
        let (camera, kernels) = match &view.blur {
            None => (None, None),
            Some(ViewBlur::Camera(camera)) => (Some(camera), None),
            Some(ViewBlur::Kernels(kernels)) => (None, Some(kernels)),
            Some(ViewBlur::Both(camera, kernels)) => (Some(camera), Some(kernels)),
        };
        let added = GalleryView {
            input: input.and_then(|image| self.jpeg(image)),
            // The same picture twice would say that something was blurred.
            seen: view.blur.as_ref().and_then(|_| self.jpeg(&view.seen)),
            sharp: self.jpeg(&view.sharp),
            truth: truth.and_then(|image| self.jpeg(image)),
            camera: camera.map(deed),
            kernels: kernels.and_then(|kernels| grid(kernels, self.kernel_bytes)),
        };
        self.views.push(added);
    }

    /// Adds a test view.
    pub(crate) fn add_test(&mut self, sharp: &Image, truth: Option<&Image>) {
        let added = GalleryView {
            sharp: self.jpeg(sharp),
            truth: truth.and_then(|image| self.jpeg(image)),
            ..GalleryView::default()
        };
        self.views.push(added);
    }

    /// Adds a view without pictures.
    pub(crate) fn leave_out(&mut self) {
        self.views.push(GalleryView::default());
    }

    fn jpeg(&self, image: &Image) -> Option<String> {
        let small = match self.factor {
            1 => encode_jpeg(image, QUALITY),
            factor => encode_jpeg(&shrink_image(image.clone(), factor), QUALITY),
        };
        small.map(|jpeg| STANDARD.encode(jpeg))
    }
}

fn deed(view: &TakenView) -> CameraDeed {
    let places = |spot: &Spot| {
        let every = spot.places.len().div_ceil(MOST_PLACES).max(1);
        let kept = spot.places.iter().step_by(every);
        // Thousandths of a pixel are shorter to write than all digits.
        kept.map(|place| place.map(|v| (v * 1000.0).round() as f32 / 1000.0))
            .collect()
    };
    let in_the_middle = view.spots.iter().filter(|spot| spot.right_px == 0.0);
    let spots = in_the_middle.map(|spot| SpotPlaces {
        depth: spot.depth,
        places: places(spot),
    });
    CameraDeed {
        path_px: view.frame.blur_px,
        disc_px: view.frame.disc_px,
        focus: view.frame.focus,
        spots: spots.collect(),
    }
}

/// The kernels in the middles of cells, in so many bytes; `None` where there is no pixel.
fn grid(view: &KernelView, bytes: usize) -> Option<KernelGrid> {
    let (width, height) = (view.intensity.width, view.intensity.height);
    let area = view.kernels.len().checked_div(width * height)?;
    let [columns, rows] = cells([width, height], bytes / area.max(1));
    let (mut intensity, mut weights) = (Vec::new(), Vec::new());
    for row in 0..rows {
        for column in 0..columns {
            let (x, y) = (
                (2 * column + 1) * width / (2 * columns),
                (2 * row + 1) * height / (2 * rows),
            );
            let pixel = y * width + x;
            let kernel = &view.kernels[pixel * area..][..area];
            let largest = kernel.iter().fold(1e-12_f32, |most, v| most.max(*v));
            intensity.push(byte(view.intensity.values[pixel]));
            weights.extend(kernel.iter().map(|v| byte(v / largest)));
        }
    }
    Some(KernelGrid {
        size: area.isqrt(),
        columns,
        rows,
        intensity: STANDARD.encode(intensity),
        weights: STANDARD.encode(weights),
    })
}

/// Columns and rows of square cells, of which there are at most so many, as far as the least number along a side lets them.
fn cells([width, height]: [usize; 2], most: usize) -> [usize; 2] {
    let longer = width.max(height);
    let first = longer.div_ceil(MOST_PLACES_ALONG).max(1);
    let last = longer.div_ceil(LEAST_PLACES_ALONG).max(first);
    let count = |cell: usize| [width, height].map(|side| side.div_ceil(cell));
    (first..last)
        .map(count)
        .find(|[columns, rows]| columns * rows <= most)
        .unwrap_or_else(|| count(last))
}

/// A number in [0, 1] in 255ths.
fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_of_any_size_keep_to_their_bytes() {
        for (frames, size, kernel) in [
            (24, [512, 288], 9),
            (152, [512, 288], 9),
            (152, [400, 400], 15),
            (300, [288, 512], 15),
            (24, [3, 2], 9),
        ] {
            let most = MOST_KERNEL_BYTES / frames / (kernel * kernel);
            let [columns, rows] = cells(size, most);
            assert!(columns * rows <= most, "{size:?}: {columns} x {rows}");
            let longer = columns.max(rows);
            assert!(longer <= MOST_PLACES_ALONG, "{size:?}: {longer}");
            // Not far fewer than there is room for.
            let all = columns * rows == size[0] * size[1];
            assert!(
                all || longer >= MOST_PLACES_ALONG - 2 || 2 * columns * rows > most,
                "{size:?}: {columns} x {rows} of {most}"
            );
        }
        // Without room for any, a few.
        assert_eq!(cells([400, 200], 0), [4, 2]);
    }
}
