//! Recognition feeds back into the objects: the pose of a recognised part says which pixels are its own.
//!
//! In: the objects of a frame and what was recognised among them. Out: the objects after that
//! ([`samsod_shadow::settle_objects`]), and the detections, which then speak of them.

use samsod_shadow::{KnownPart, ObjectRegion, settle_objects};

use crate::{Detection, Method};

/// The objects of a frame after its parts were recognised; the detections then say which of them they cover.
///
/// A recognised part becomes one object with the pixels that its pose gives it, whatever the separation of shadows made of
/// them. What it leaves of an object stays an object of its own, which is an unknown one where no detection speaks of it; an
/// unknown object of which nothing is left is no detection any more.
///
/// # Arguments
/// * `objects` - those that were given to [`Recognizer::recognize`](crate::Recognizer::recognize)
/// * `detections` - what it returned
/// * `min_area_px` - connected pixels fewer than these are no object, unless they are a recognised part
pub fn settle(objects: &[ObjectRegion], detections: &mut Vec<Detection>, min_area_px: u32) -> Vec<ObjectRegion> {
    let mut spoken_of: Vec<usize> = detections.iter().flat_map(|detection| &detection.objects).copied().collect();
    spoken_of.sort_unstable();
    let named: Vec<usize> = (0..detections.len()).filter(|&i| detections[i].name.is_some()).collect();
    let mut order = named;
    // Where two parts overlap the likelier one has the pixels.
    order.sort_by(|&a, &b| detections[b].score.total_cmp(&detections[a].score));
    let parts: Vec<KnownPart<'_>> =
        order.iter().map(|&i| KnownPart { region: detections[i].region, mask: &detections[i].mask }).collect();
    let settled = settle_objects(objects, &parts, min_area_px);
    for (&i, own) in order.iter().zip(&settled.of_parts) {
        detections[i].objects = own.iter().copied().collect();
    }
    for detection in detections.iter_mut().filter(|detection| detection.name.is_none()) {
        let remains = detection.objects.iter().flat_map(|&i| settled.remains.get(i).into_iter().flatten().copied());
        let mut remains: Vec<usize> = remains.collect();
        remains.sort_unstable();
        remains.dedup();
        // Of an object in pieces, the largest: they are sorted.
        if let Some(object) = remains.first().and_then(|&i| settled.objects.get(i)) {
            detection.mask.clone_from(&object.mask);
            detection.image.origin_px = object.centroid.map(f64::from);
            detection.image.angle_rad = f64::from(object.axis_rad);
        }
        detection.objects = remains;
    }
    detections.retain(|detection| detection.name.is_some() || !detection.objects.is_empty());
    // What a part leaves of an object that only it covered: nothing else was looked for there.
    for index in spoken_of.into_iter().flat_map(|i| settled.remains.get(i).into_iter().flatten().copied()) {
        let Some(object) = settled.objects.get(index) else { continue };
        if !detections.iter().any(|detection| detection.objects.contains(&index)) {
            detections.push(Detection::unknown(object, index, 0.0, 0.0, Method::Shape));
        }
    }
    settled.objects
}

#[cfg(test)]
mod tests {
    use samsod_shadow::Mask;

    use super::*;
    use crate::ImagePose;
    use crate::test_parts::{object, rectangle};

    fn detection(name: Option<&str>, score: f32, objects: &[usize], mask: Mask) -> Detection {
        Detection {
            region: 0,
            objects: objects.to_vec(),
            name: name.map(str::to_owned),
            method: Method::Shape,
            score,
            margin: score,
            image: ImagePose { origin_px: [0.0, 0.0], angle_rad: 1.0 },
            world: None,
            mask,
        }
    }

    #[test]
    fn detections_speak_of_the_objects_after_them() {
        // Two pieces of one part, of the second a neighbour is a piece, too; and a seam beside them.
        let before = [
            object(0, rectangle([10, 10, 20, 20]), Some(rectangle([60, 10, 10, 20]))),
            object(0, rectangle([32, 10, 28, 20]), None),
            object(0, rectangle([10, 30, 20, 2]), None),
        ];
        let mut detections = vec![
            detection(Some("late"), 0.6, &[1], rectangle([38, 10, 4, 20])),
            detection(Some("plate"), 0.9, &[0, 1], rectangle([10, 10, 30, 21])),
            detection(None, 0.2, &[1], before[1].mask.clone()),
            detection(None, 0.1, &[2], before[2].mask.clone()),
        ];
        let after = settle(&before, &mut detections, 20);
        let names: Vec<Option<&str>> = detections.iter().map(|d| d.name.as_deref()).collect();
        assert_eq!(names, [Some("late"), Some("plate"), None], "of the seam nothing is left");
        let [late, plate, unknown] = &detections[..] else { panic!("{detections:?}") };
        let area = |d: &Detection| d.objects.iter().map(|&i| after[i].area).collect::<Vec<_>>();
        assert_eq!((area(plate), area(late), area(unknown)), (vec![630], vec![40], vec![360]));
        assert_eq!(after[unknown.objects[0]].mask, rectangle([42, 10, 18, 20]));
        assert_eq!(unknown.mask, after[unknown.objects[0]].mask);
        assert_eq!(unknown.image.origin_px, [50.5, 19.5]);
        assert!((unknown.image.angle_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!((plate.image.origin_px, plate.image.angle_rad), ([0.0, 0.0], 1.0));
        assert_eq!(after.iter().filter_map(|o| o.shadow.as_ref()).map(Mask::area).sum::<u32>(), 200);
    }

    #[test]
    fn what_a_part_leaves_is_unknown() {
        // One object; the part found in it covers its left half.
        let before = [object(0, rectangle([10, 10, 40, 20]), None)];
        let mut detections = vec![detection(Some("plate"), 0.9, &[0], rectangle([10, 10, 20, 20]))];
        let after = settle(&before, &mut detections, 20);
        let [_, rest] = &detections[..] else { panic!("{detections:?}") };
        assert_eq!((rest.name.as_deref(), rest.score, rest.region), (None, 0.0, 0));
        let [index] = rest.objects[..] else { panic!("{rest:?}") };
        assert_eq!((&after[index].mask, &rest.mask), (&rectangle([30, 10, 20, 20]), &rectangle([30, 10, 20, 20])));
        assert_eq!(rest.image.origin_px, [39.5, 19.5]);
        // Nothing that counts is left: no detection more.
        let mut detections = vec![detection(Some("plate"), 0.9, &[0], rectangle([10, 10, 39, 20]))];
        assert_eq!((settle(&before, &mut detections, 20).len(), detections.len()), (1, 1));
    }

    #[test]
    fn without_a_name_nothing_changes() {
        let before = [object(2, rectangle([10, 10, 20, 20]), None), object(4, rectangle([50, 10, 5, 5]), None)];
        let mut detections = vec![detection(None, 0.2, &[1], before[1].mask.clone())];
        let after = settle(&before, &mut detections, 71);
        assert_eq!(after, before);
        assert_eq!((detections[0].objects.as_slice(), &detections[0].mask), (&[1][..], &before[1].mask));
    }
}
