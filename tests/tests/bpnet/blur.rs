//! The blur op and what is derived from a blur field, on every backend: gradients against central
//! differences in f64, borders, exact cases.

use bpnet::{BlurField, blur, cell_means, composite, kernel_center_loss};
use burn::tensor::{DType, Tensor};
use limpid_tests::{GradLimits, check_gradients, devices, devices_in, tensor, unit_noise, values};

#[test]
fn the_blur_has_the_gradients_of_image_and_kernel() {
    for (name, device) in devices_in(DType::F64) {
        // A kernel larger than the image, borders all around, images of one row and one pixel.
        for (height, width, k) in [
            (4, 5, 1),
            (10, 4, 3),
            (6, 7, 5),
            (4, 9, 7),
            (3, 4, 9),
            (7, 5, 11),
            (3, 5, 13),
            (2, 3, 15),
            (1, 4, 3),
            (1, 1, 5),
        ] {
            let pixels = height * width;
            let image = unit_noise(pixels * 3, 1);
            let kernel: Vec<f64> = unit_noise(pixels * k * k, 2)
                .iter()
                .map(|v| v + 0.1)
                .collect();
            eprintln!("{name}: {height} x {width}, K = {k}");
            let loss = |image: Tensor<2>, kernel: Tensor<2>| {
                let image = image.reshape([height, width, 3]);
                let kernel = kernel.reshape([height, width, k * k]);
                let blurred = blur(image, kernel).expect("the shapes fit");
                let target = tensor(
                    &unit_noise(pixels * 3, 5),
                    [height, width, 3],
                    &blurred.device(),
                    DType::F64,
                );
                (blurred - target).powi_scalar(2).sum()
            };
            // Where only one weight is inside the image, the kernel cancels against its own sum: the
            // image alone is checked.
            if k == 1 || pixels == 1 {
                check_gradients(
                    &device,
                    &[("image", [pixels, 3], image)],
                    &[],
                    GradLimits::default(),
                    |leaves| {
                        let device = leaves[0].device();
                        let kernel = tensor(&kernel.clone(), [pixels, k * k], &device, DType::F64);
                        loss(leaves[0].clone(), kernel)
                    },
                );
            } else {
                check_gradients(
                    &device,
                    &[
                        ("image", [pixels, 3], image),
                        ("kernel", [pixels, k * k], kernel),
                    ],
                    &[],
                    GradLimits::default(),
                    |leaves| loss(leaves[0].clone(), leaves[1].clone()),
                );
            }
        }
    }
}

#[test]
fn the_blur_does_not_mind_how_its_inputs_lie_in_memory() {
    for (name, device) in devices() {
        let image = tensor::<3>(&unit_noise(3 * 6 * 5, 1), [3, 6, 5], &device, DType::F32);
        let kernel = tensor::<3>(&unit_noise(9 * 5 * 6, 2), [9, 5, 6], &device, DType::F32);
        let image = image.permute([1, 2, 0]); // [6, 5, 3]
        let kernel = kernel.permute([2, 1, 0]); // [6, 5, 9]
        let copy = |t: &Tensor<3>| Tensor::<3>::from_data(t.to_data(), (&device, DType::F32));
        let expected = values(blur(copy(&image), copy(&kernel)).expect("the shapes fit"));
        let permuted = values(blur(image, kernel).expect("the shapes fit"));
        assert_eq!(permuted, expected, "{name}");
    }
}

#[test]
fn a_delta_kernel_returns_the_image_whatever_the_intensity() {
    for (name, device) in devices() {
        for k in [1, 9, 15] {
            let mut kernel = vec![0.0; 4 * 6 * k * k];
            for pixel in kernel.chunks_exact_mut(k * k) {
                pixel[k * k / 2] = 1.0;
            }
            let field = BlurField::new(
                tensor(&kernel, [4, 6, k * k], &device, DType::F32),
                tensor(&unit_noise(24, 4), [4, 6], &device, DType::F32),
            )
            .expect("the shapes fit");
            let image = tensor::<3>(&unit_noise(72, 1), [4, 6, 3], &device, DType::F32);
            let output = composite(image.clone(), &field).expect("the shapes fit");
            assert_eq!(values(output.picture()), values(image), "{name}, K = {k}");
        }
    }
}

#[test]
fn a_kernel_with_one_weight_fetches_the_pixel_it_points_at() {
    for (name, device) in devices() {
        // Index ky * K + kx = 5 of 3 x 3 is the pixel to the right.
        let mut kernel = vec![0.0; 2 * 3 * 9];
        for pixel in kernel.chunks_exact_mut(9) {
            pixel[5] = 1.0;
        }
        let image = tensor::<3>(&unit_noise(18, 1), [2, 3, 3], &device, DType::F32);
        let field = BlurField::new(
            tensor(&kernel, [2, 3, 9], &device, DType::F32),
            tensor(&[0.5; 6], [2, 3], &device, DType::F32),
        )
        .expect("the shapes fit");
        let output = blur(image.clone(), field.kernel()).expect("the shapes fit");
        let inner = output.narrow(1, 0, 2);
        assert_eq!(
            values(inner),
            values(image.clone().narrow(1, 1, 2)),
            "{name}"
        );
        let moved = composite(image, &field).expect("the shapes fit");
        assert_eq!(
            values(moved.centroid()),
            [0.5, 0.0].repeat(6),
            "{name}: half of one pixel to the right"
        );
    }
}

#[test]
fn cells_cover_the_picture_whatever_its_size() {
    for (name, device) in devices_in(DType::F64) {
        // 5 columns in 2 cells: 0 to 2 and 2 to 4; 3 rows in 4 cells: 0, 0 to 1, 1 to 2, 2.
        let map: Vec<f64> = (0..30).map(f64::from).collect();
        let means = values(cell_means(
            tensor(&map, [3, 5, 2], &device, DType::F64),
            4,
            2,
        ));
        let column = |first: f64| 2.0 * (first + 1.0);
        for (row, middle) in [0.0, 0.5, 1.5, 2.0].into_iter().enumerate() {
            for (col, first) in [0.0, 2.0].into_iter().enumerate() {
                let expected = 10.0 * middle + column(first);
                let cell = &means[(row * 2 + col) * 2..][..2];
                assert!(
                    (cell[0] - expected).abs() < 1e-12,
                    "{name}: cell {row}, {col}"
                );
                assert!(
                    (cell[1] - expected - 1.0).abs() < 1e-12,
                    "{name}: cell {row}, {col}"
                );
            }
        }
        let one = cell_means(tensor(&[3.0, 4.0], [1, 1, 2], &device, DType::F64), 4, 8);
        assert_eq!(values(one), [3.0, 4.0].repeat(32), "{name}");
    }
}

#[test]
fn sparsity_is_the_distance_from_the_centre_weight_to_its_target() {
    for (name, device) in devices_in(DType::F64) {
        let weight = tensor(&[1.0, 0.25, 0.5], [1, 3], &device, DType::F64);
        let intensity = tensor(&[0.0, 0.5, 1.0], [1, 3], &device, DType::F64);
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let expected = ((1.0 - sigmoid(5.0)) + (sigmoid(2.5) - 0.25)) / 3.0;
        let loss = values(kernel_center_loss(weight, intensity))[0];
        assert!(
            (loss - expected).abs() < 1e-12,
            "{name}: {loss} against {expected}"
        );
    }
}
