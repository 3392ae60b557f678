//! What holds of every partition, on random pictures and parameters.

mod support;

use proptest::prelude::*;
use samsod_segment::{Partition, SegmentParams};

use support::{assert_agrees_with_direct_count, components, params, pictures, segmenter};

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config(256))]

    /// Dense, 4-connected, disjoint, covering; area, mean, centroid, box, neighbours and runs as counted directly.
    #[test]
    fn a_partition_is_what_a_direct_count_finds(picture in pictures(), params in params()) {
        let partition = segmenter(params).segment(&picture.view()).unwrap();
        assert_agrees_with_direct_count(&partition, &picture);
        prop_assert_eq!(components(partition.labels(), picture.width as usize), partition.len(), "every one connected");
    }

    #[test]
    fn no_partition_is_below_the_minimum_area_unless_it_is_the_only_one(
        picture in pictures(),
        params in params(),
        min_area in prop_oneof![1..120u32, Just(u32::MAX)],
    ) {
        let params = SegmentParams { min_area_px: Some(min_area), ..params };
        let partition = segmenter(params).segment(&picture.view()).unwrap();
        let smallest = partition.objects().iter().map(|o| o.area).min().unwrap();
        prop_assert!(partition.len() == 1 || smallest >= min_area, "{} of {} px", partition.len(), smallest);
    }

    /// Labels taken out and put in again describe the same partition; where shadows fade out is not in them.
    #[test]
    fn from_labels_restores_a_partition(picture in pictures()) {
        let partition = segmenter(SegmentParams { penumbra_light: 1.0, ..SegmentParams::default() }).segment(&picture.view()).unwrap();
        let restored = Partition::from_labels(&picture.view(), partition.labels().to_vec()).unwrap();
        prop_assert!(restored == partition);
    }
}

proptest! {
    #![proptest_config(config(96))]

    #[test]
    fn the_number_of_threads_changes_nothing(picture in pictures(), params in params()) {
        let with_threads = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| segmenter(params.clone()).segment(&picture.view()).unwrap())
        };
        prop_assert!(with_threads(1) == with_threads(4));
    }

    /// Neither an earlier image nor one of another size leaves anything behind in the reused memory.
    #[test]
    fn reused_memory_changes_nothing(first in pictures(), second in pictures(), params in params()) {
        let fresh = |picture: &support::Picture| segmenter(params.clone()).segment(&picture.view()).unwrap();
        let (first_alone, second_alone) = (fresh(&first), fresh(&second));
        let mut reused = segmenter(params.clone());
        let mut partition = Partition::default();
        for (picture, alone) in [(&first, &first_alone), (&first, &first_alone), (&second, &second_alone), (&first, &first_alone)] {
            reused.segment_into(&picture.view(), &mut partition).unwrap();
            prop_assert!(partition == *alone);
            assert_agrees_with_direct_count(&partition, picture);
        }
    }

    /// Without a gain for texture: in a picture of few pixels a part counts as texture of the table.
    #[test]
    fn two_flat_colours_are_cut_exactly(
        width in 24..=90u32,
        height in 24..=90u32,
        place in [0..1000u32, 0..1000],
        size in [0..1000u32, 0..1000],
        ground in any::<[u8; 3]>(),
        shift in [64..=192u8, 64..=192, 64..=192],
    ) {
        // A rectangle of at least 8 px a side, clear of the border.
        let fit = |range: u32, thousandths: u32| range * thousandths / 1000;
        let [w, h] = [8 + fit(width - 10, size[0]), 8 + fit(height - 10, size[1])];
        let [x0, y0] = [1 + fit(width - 1 - w, place[0]), 1 + fit(height - 1 - h, place[1])];
        let colour = [0, 1, 2].map(|c| ground[c].wrapping_add(shift[c]));
        let inside = |x: i64, y: i64| {
            (i64::from(x0)..i64::from(x0 + w)).contains(&x) && (i64::from(y0)..i64::from(y0 + h)).contains(&y)
        };
        let mut picture = support::Picture::flat(width, height, ground);
        picture.paint(colour, inside);
        let params = SegmentParams { texture_gain: 0.0, ..SegmentParams::default() };
        let partition = segmenter(params).segment(&picture.view()).unwrap();
        prop_assert_eq!(partition.len(), 2);
        let wanted: Vec<u32> = (0..i64::from(width * height))
            .map(|i| u32::from(inside(i % i64::from(width), i / i64::from(width))))
            .collect();
        prop_assert!(partition.labels() == wanted);
    }
}
