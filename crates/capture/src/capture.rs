//! Path, focus and lens of every frame, and the poses that follow from them.

use burn::tensor::{DType, Device, Tensor, TensorData};
use host::read;

use crate::motion::{RIGID, moved};
use crate::samples::Sample;
use crate::taken::Taken;

/// What a camera did while it took N frames: the tensors that can be trained, all of rank 2.
///
/// With s the moment from -1/2 to 1/2 and (u, v) the point of the lens, a frame sees the world from
/// Shear(u, v) M(p₁ s + … + p_D s^D) P, where P is its pose, p its path and M what [`moved`] makes of six numbers: the sharp
/// picture is that of the middle of the exposure, s = 0, u = v = 0, from P.
///
/// The shear is x += a u (d z - S) and the same for y, with the aperture a, the focus d and the scene's size S: a point
/// at the depth S / d stays where the lens' middle sees it, and one at depth z moves by f a u (d - S / z) px.
#[derive(Clone, Debug)]
pub struct Capture {
    /// Coefficients of the paths, [N, 6 D]: those of s first.
    pub paths: Tensor<2>,
    /// Disparity of focus, S / distance, [N, 1].
    pub focus: Tensor<2>,
    /// Radius of the lens for all frames, scene sizes, [1, 1]. Its sign is without meaning.
    pub aperture: Tensor<2>,
    /// How long the shutter is open, in units of frames, [1, 1].
    pub shutter: Tensor<2>,
}

impl Capture {
    /// A camera that stands still, without a lens, in focus at the scene's size, for paths of a degree.
    #[must_use]
    pub fn still(num_frames: usize, degree: usize, options: (&Device, DType)) -> Self {
        Self {
            paths: Tensor::zeros([num_frames, RIGID * degree], options),
            focus: Tensor::ones([num_frames, 1], options),
            aperture: Tensor::zeros([1, 1], options),
            shutter: Tensor::zeros([1, 1], options),
        }
    }

    /// Degree D of the paths.
    #[must_use]
    pub fn degree(&self) -> usize {
        self.paths.dims()[1] / RIGID
    }

    /// The poses of a frame's samples, [n, 3, 4]; `middle` is the frame's pose, [3, 4], `size` the scene's size S.
    ///
    /// # Panics
    /// Where there is no such frame or no sample.
    #[must_use]
    #[expect(
        clippy::disallowed_methods,
        reason = "paths are small, and what a GPU rounds is a share of them"
    )]
    pub fn poses(
        &self,
        frame: usize,
        middle: &Tensor<2>,
        samples: &[Sample],
        size: f64,
    ) -> Tensor<3> {
        assert!(!samples.is_empty(), "an exposure without samples");
        let (n, degree) = (samples.len(), self.degree());
        let options = (&middle.device(), middle.dtype());
        let row = |tensor: &Tensor<2>| tensor.clone().narrow(0, frame, 1);
        let powers: Vec<f64> = samples
            .iter()
            .flat_map(|sample| (1..=degree).map(|k| sample.moment.powi(k as i32)))
            .collect();
        let powers = Tensor::<2>::from_data(TensorData::new(powers, [n, degree]), options);
        let path = powers.matmul(row(&self.paths).reshape([degree, RIGID])); // [n, 6]
        let rigid = moved(path, middle, size);

        let points: Vec<f64> = samples.iter().flat_map(|sample| sample.lens).collect();
        let points = Tensor::<2>::from_data(TensorData::new(points, [n, 2]), options);
        let slopes = points * self.aperture.clone(); // [n, 2]
        let slopes =
            Tensor::cat(vec![slopes, Tensor::zeros([n, 1], options)], 1).reshape([n, 3, 1]);
        let depth = rigid.clone().narrow(1, 2, 1) * row(&self.focus).reshape([1, 1, 1]); // [n, 1, 4]
        let ahead = TensorData::new(vec![0.0, 0.0, 0.0, size], [1, 1, 4]);
        rigid + slopes * (depth - Tensor::<3>::from_data(ahead, options))
    }

    /// Times of samples, relative to the frame's own, in units of frames, `[n]`.
    #[must_use]
    pub fn moments(&self, samples: &[Sample]) -> Tensor<1> {
        let options = (&self.shutter.device(), self.shutter.dtype());
        let moments: Vec<f64> = samples.iter().map(|sample| sample.moment).collect();
        let moments = Tensor::<1>::from_data(TensorData::new(moments, [samples.len()]), options);
        moments * self.shutter.clone().reshape([1])
    }

    /// What the camera did in a frame, in main memory: the device is waited for once.
    ///
    /// # Panics
    /// Where there is no such frame.
    #[must_use]
    pub fn taken(&self, frame: usize) -> Taken {
        let [found] = self.read(frame, 1).try_into().expect("one frame");
        found
    }

    /// The same of all frames, in their order.
    #[must_use]
    pub fn all_taken(&self) -> Vec<Taken> {
        self.read(0, self.paths.dims()[0])
    }

    /// What the camera did in `count` frames from one on.
    fn read(&self, first: usize, count: usize) -> Vec<Taken> {
        let of_frames = |tensor: &Tensor<2>| {
            let rows = tensor.clone().detach().narrow(0, first, count);
            rows.flatten::<1>(0, 1)
        };
        let of_all = |tensor: &Tensor<2>| tensor.clone().detach().flatten::<1>(0, 1);
        let all = [
            of_frames(&self.paths),
            of_frames(&self.focus),
            of_all(&self.aperture),
            of_all(&self.shutter),
        ];
        let values: Vec<f64> = read(Tensor::cat(all.to_vec(), 0)).iter().collect();
        let width = RIGID * self.degree();
        let (paths, others) = values.split_at(width * count);
        let (aperture, shutter) = (others[count], others[count + 1]);
        let frames = paths.chunks_exact(width).zip(others);
        let taken = frames.map(|(path, focus)| Taken {
            path: path.to_vec(),
            focus: *focus,
            aperture,
            shutter,
        });
        taken.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{samples, shift_of, turn_of};

    const SIZE: f64 = 3.0;

    fn device() -> Device {
        Device::flex().autodiff()
    }

    fn tensor(values: Vec<f64>, shape: [usize; 2]) -> Tensor<2> {
        Tensor::from_data(TensorData::new(values, shape), (&device(), DType::F64))
    }

    fn given() -> Tensor<2> {
        tensor(
            vec![0.8, 0.0, 0.6, 0.3, 0.0, 1.0, 0.0, -0.2, -0.6, 0.0, 0.8, 0.5],
            [3, 4],
        )
    }

    /// Two frames; every number of the second is some other.
    fn capture() -> Capture {
        let some = |count: usize, scale: f64| -> Vec<f64> {
            (0..count)
                .map(|k| scale * (1.7 * k as f64 + 0.4).sin())
                .collect()
        };
        Capture {
            paths: tensor(some(24, 0.02), [2, 12]),
            focus: tensor(vec![1.3, 0.8], [2, 1]),
            aperture: tensor(vec![0.02], [1, 1]),
            shutter: tensor(vec![0.9], [1, 1]),
        }
    }

    fn values<const D: usize>(tensor: &Tensor<D>) -> Vec<f64> {
        let values = tensor.clone().detach().try_into_vec_as::<f64>();
        values.expect("f64")
    }

    #[test]
    fn the_middle_of_a_still_camera_is_the_given_pose() {
        let still = Capture::still(2, 3, (&device(), DType::F64));
        let poses = still.poses(1, &given(), &samples(4, 0.7), SIZE);
        assert_eq!(values(&poses), values(&given()).repeat(4));
    }

    #[test]
    fn one_sample_is_the_middle_of_the_exposure() {
        let capture = capture();
        let middle = values(&given());
        let poses = values(&capture.poses(1, &given(), &samples(1, 0.3), SIZE));
        for (a, b) in middle.iter().zip(&poses) {
            assert!((a - b).abs() < 1e-15, "{a} {b}");
        }
    }

    /// Where a point of the world is in the image, in focal lengths, and its depth.
    fn seen(pose: &[f64], [x, y, z]: [f64; 3]) -> [f64; 3] {
        let row = |i: usize| {
            pose[4 * i] * x + pose[4 * i + 1] * y + pose[4 * i + 2] * z + pose[4 * i + 3]
        };
        [row(0) / row(2), row(1) / row(2), row(2)]
    }

    #[test]
    fn what_is_in_focus_stays_where_it_is_from_every_point_of_the_lens() {
        let mut capture = capture();
        capture.paths = capture.paths.clone() * 0.0;
        let middle = values(&given());
        let rim = [[1.0, 0.0], [0.6, 0.8], [-0.8, -0.6], [0.3, 0.1]];
        let taken = rim.map(|lens| Sample { moment: 0.0, lens });
        let poses = values(&capture.poses(0, &given(), &taken, SIZE));
        // A point of the camera's at (0.2, -0.1) and some depth, taken back to the world.
        let at_depth = |depth: f64| -> [f64; 3] {
            let p = [
                0.2 * depth - middle[3],
                -0.1 * depth - middle[7],
                depth - middle[11],
            ];
            std::array::from_fn(|j| (0..3).map(|i| middle[4 * i + j] * p[i]).sum())
        };
        let largest = |depth: f64| -> f64 {
            let [x, y, z] = seen(&middle, at_depth(depth));
            assert!((z - depth).abs() < 1e-12, "the point's depth");
            let away = poses.chunks_exact(12).map(|pose| {
                let [a, b, c] = seen(pose, at_depth(depth));
                assert!((c - depth).abs() < 1e-12, "a shear leaves depth alone");
                (a - x).hypot(b - y)
            });
            away.fold(0.0, f64::max)
        };
        assert!(largest(SIZE / 1.3) < 1e-12, "in focus");
        for depth in [1.0, 2.0, 5.0] {
            let expected = 0.5 * capture.taken(0).disc_px(1.0, SIZE / depth);
            let found = largest(depth);
            assert!(
                (found - expected).abs() < 1e-12,
                "depth {depth}: {found}, {expected}"
            );
        }
    }

    #[test]
    fn the_length_of_a_path_is_how_far_the_image_moves() {
        let mut capture = capture();
        capture.aperture = capture.aperture.clone() * 0.0;
        let given = tensor(
            vec![1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            [3, 4],
        );
        let moments: Vec<Sample> = (0..=200)
            .map(|k| Sample::through_the_middle(f64::from(k) / 200.0 - 0.5))
            .collect();
        let poses = values(&capture.poses(0, &given, &moments, SIZE));
        let places: Vec<_> = poses
            .chunks_exact(12)
            .map(|pose| seen(pose, [0.0, 0.0, SIZE]))
            .collect();
        let length: f64 = places
            .windows(2)
            .map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]))
            .sum();
        let found = capture.taken(0).path_px(100.0);
        assert!(
            (found - 100.0 * length).abs() < 0.05 * found,
            "{found} px, {} px",
            100.0 * length
        );
    }

    /// Mean place of what is ahead at the depth S in the picture of frame 1, from 400 moments; small motions.
    fn mean_place(capture: &Capture) -> [f64; 2] {
        let ahead = tensor(
            vec![1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            [3, 4],
        );
        let moments = (0..400).map(|k| (f64::from(k) + 0.5) / 400.0 - 0.5);
        let moments: Vec<Sample> = moments.map(Sample::through_the_middle).collect();
        let poses = values(&capture.poses(1, &ahead, &moments, SIZE));
        let places = poses
            .chunks_exact(12)
            .map(|pose| seen(pose, [0.0, 0.0, SIZE]));
        places.fold([0.0; 2], |sum, place| {
            [0, 1].map(|axis| sum[axis] + place[axis] / 400.0)
        })
    }

    #[test]
    fn the_mean_shift_is_that_of_the_picture_and_bending_moves_it_alone() {
        for degree in [2, 3, 4] {
            let numbers = (0..12 * degree).map(|k| 1e-4 * (1.3 * f64::from(k)).cos());
            let mut capture = capture();
            capture.paths = tensor(numbers.collect(), [2, 6 * degree as usize]);
            let mut taken = capture.all_taken().swap_remove(1);
            let before = shift_of(taken.mean_motion());
            // What is left out is of the second order in the motions.
            let place = mean_place(&capture);
            for (before, place) in before.iter().zip(place) {
                assert!((before - place).abs() < 1e-7, "{degree}: {before} {place}");
            }

            let (straight, by) = (taken.path[..RIGID].to_vec(), [-2e-4, 5e-4]);
            taken.bend(turn_of(by));
            for (axis, after) in shift_of(taken.mean_motion()).into_iter().enumerate() {
                assert!((after - before[axis] - by[axis]).abs() < 1e-15, "{degree}");
            }
            assert_eq!(taken.path[..RIGID], straight);
            let first = capture.taken(0).path;
            let paths = [first, taken.path.clone()].concat();
            capture.paths = tensor(paths, [2, 6 * degree as usize]);
            let after = shift_of(taken.mean_motion());
            for (after, place) in after.iter().zip(mean_place(&capture)) {
                assert!((after - place).abs() < 1e-6, "{degree}: {after} {place}");
            }

            let before = taken.mean_motion();
            let by: [f64; RIGID] = std::array::from_fn(|k| 1e-3 * (k as f64 - 2.0));
            taken.bend(by);
            for (number, after) in taken.mean_motion().into_iter().enumerate() {
                assert!(
                    (after - before[number] - by[number]).abs() < 1e-15,
                    "{degree}"
                );
            }
        }
    }

    #[test]
    fn all_frames_are_read_as_each_is() {
        let capture = capture();
        assert_eq!(capture.all_taken(), [capture.taken(0), capture.taken(1)]);
    }

    #[test]
    fn moments_are_parts_of_the_shutters_time() {
        let moments = [-0.5, -0.1, 0.0, 0.4];
        let taken = moments.map(Sample::through_the_middle);
        let moments = values(&capture().moments(&taken));
        for (moment, expected) in moments.iter().zip([-0.45, -0.09, 0.0, 0.36]) {
            assert!((moment - expected).abs() < 1e-12, "{moment}");
        }
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let taken = samples(5, 0.6);
        let weights: Vec<f64> = (0..60).map(|k| (0.9 * f64::from(k)).cos()).collect();
        let weights =
            Tensor::<3>::from_data(TensorData::new(weights, [5, 3, 4]), (&device(), DType::F64));
        let loss = |capture: &Capture| {
            let poses = capture.poses(1, &given(), &taken, SIZE) * weights.clone();
            poses.sum() + capture.moments(&taken).square().sum()
        };
        type Field = fn(&mut Capture) -> &mut Tensor<2>;
        let fields: [(&str, Field); 4] = [
            ("paths", |c| &mut c.paths),
            ("focus", |c| &mut c.focus),
            ("aperture", |c| &mut c.aperture),
            ("shutter", |c| &mut c.shutter),
        ];
        for (name, field) in fields {
            for zero in [false, true] {
                let mut at = capture();
                if zero {
                    *field(&mut at) = field(&mut at).clone() * 0.0;
                }
                let leaf = field(&mut at).clone().detach().require_grad();
                *field(&mut at) = leaf.clone();
                let grads = loss(&at).backward();
                let found = values(&Tensor::<2>::from_inner(
                    leaf.grad(&grads).expect("a gradient"),
                ));
                let (start, shape) = (values(&leaf), leaf.dims());
                for (k, found) in found.iter().enumerate() {
                    let value = |delta: f64| {
                        let (mut moved, mut numbers) = (at.clone(), start.clone());
                        numbers[k] += delta;
                        *field(&mut moved) = tensor(numbers, shape);
                        values(&loss(&moved))[0]
                    };
                    let numeric = (value(1e-6) - value(-1e-6)) / 2e-6;
                    assert!(
                        (found - numeric).abs() < 1e-7 * (1.0 + numeric.abs()),
                        "{name}, entry {k}, zero {zero}: {found} {numeric}"
                    );
                }
            }
        }
    }
}
