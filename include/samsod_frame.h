/*
 * The shared-memory contract between frame clients and samsodd, for C and C++.
 *
 * Transport is iceoryx2 0.10. Two services are opened per cell, each beside an event service of the same name that wakes the
 * waiting side: whoever sends notifies event id SAMSOD_SENT_EVENT.
 *
 *   service                 payload (slice of uint8_t)               user header            direction
 *   samsod/<cell>/frames    the rows of the picture                  samsod_frame_header    client -> samsodd
 *   samsod/<cell>/scenes    one UTF-8 JSON object                    samsod_scene_header    samsodd -> local clients
 *
 * Payload type: name "u8", dynamic, size 1, alignment 1. User header: fixed size, the type names below. Settings of the services,
 * which must be the same for all participants unless samsodd's [frames] says otherwise:
 *
 *   frames: safe overflow, history 0, buffer 2, borrowed 2, 2 publishers, 4 subscribers, 16 nodes
 *   scenes: safe overflow, history 0, buffer 8, borrowed 2, 2 publishers, 4 subscribers, 16 nodes
 *   events: 2 notifiers, 4 listeners, 16 nodes
 *
 * Native byte order. A changed layout has another type name, so that participants of different versions refuse each other.
 */
#ifndef SAMSOD_FRAME_H
#define SAMSOD_FRAME_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
#define SAMSOD_ASSERT(condition, message) static_assert(condition, message)
#else
#define SAMSOD_ASSERT(condition, message) _Static_assert(condition, message)
#endif

#define SAMSOD_FRAME_HEADER_TYPE_NAME "SamsodFrameHeaderV2"
#define SAMSOD_SCENE_HEADER_TYPE_NAME "SamsodSceneHeaderV1"

/* Event id that is notified after each send. */
#define SAMSOD_SENT_EVENT 1

/* Largest width and height, px, and stride, bytes, that are accepted. */
#define SAMSOD_MAX_SIDE_PX 16384
#define SAMSOD_MAX_STRIDE_BYTES 65536

/* How the bytes of a row are to be read, one byte a sample. The letters of a Bayer format are the first two pixels of the first
 * row; the second row has the other two of R, G, G, B across from them. */
enum samsod_pixel_format {
    SAMSOD_RGB8 = 1,
    SAMSOD_BGR8 = 2,
    SAMSOD_MONO8 = 3,
    SAMSOD_BAYER_RG8 = 4,
    SAMSOD_BAYER_GR8 = 5,
    SAMSOD_BAYER_GB8 = 6,
    SAMSOD_BAYER_BG8 = 7
};

/* In front of every frame. Rows follow from top to bottom; the last one need not be padded to the stride. */
typedef struct samsod_frame_header {
    uint64_t sequence;       /* 0 for the first frame of a publisher, then one more each, without gaps */
    uint64_t timestamp_ns;   /* ns since the Unix epoch: when it was handed over, or its first byte came from the camera */
    uint32_t width;          /* px, 1 to SAMSOD_MAX_SIDE_PX */
    uint32_t height;         /* px, 1 to SAMSOD_MAX_SIDE_PX */
    uint32_t stride;         /* bytes from the start of a row to that of the next, at least the row */
    uint32_t pixel_format;   /* a samsod_pixel_format */
    char camera[32];         /* UTF-8 without control characters, at most 31 bytes, filled up with zeros */
    uint64_t camera_frame;   /* the camera's own number of the frame, 0 where it has none */
    uint64_t camera_time_ns; /* ns on the camera's own clock, 0 where it has none */
} samsod_frame_header;

/* How a scene is written. */
enum samsod_scene_encoding { SAMSOD_SCENE_JSON = 1 };

/* In front of every scene. */
typedef struct samsod_scene_header {
    uint64_t sequence;     /* that of the frame */
    uint64_t timestamp_ns; /* that of the frame */
    uint32_t encoding;     /* a samsod_scene_encoding */
    uint32_t reserved;     /* 0 */
} samsod_scene_header;

SAMSOD_ASSERT(sizeof(samsod_frame_header) == 80, "frame header has 80 bytes");
SAMSOD_ASSERT(offsetof(samsod_frame_header, sequence) == 0, "sequence at 0");
SAMSOD_ASSERT(offsetof(samsod_frame_header, timestamp_ns) == 8, "timestamp_ns at 8");
SAMSOD_ASSERT(offsetof(samsod_frame_header, width) == 16, "width at 16");
SAMSOD_ASSERT(offsetof(samsod_frame_header, height) == 20, "height at 20");
SAMSOD_ASSERT(offsetof(samsod_frame_header, stride) == 24, "stride at 24");
SAMSOD_ASSERT(offsetof(samsod_frame_header, pixel_format) == 28, "pixel_format at 28");
SAMSOD_ASSERT(offsetof(samsod_frame_header, camera) == 32, "camera at 32");
SAMSOD_ASSERT(offsetof(samsod_frame_header, camera_frame) == 64, "camera_frame at 64");
SAMSOD_ASSERT(offsetof(samsod_frame_header, camera_time_ns) == 72, "camera_time_ns at 72");
SAMSOD_ASSERT(sizeof(samsod_scene_header) == 24, "scene header has 24 bytes");
SAMSOD_ASSERT(offsetof(samsod_scene_header, timestamp_ns) == 8, "timestamp_ns at 8");
SAMSOD_ASSERT(offsetof(samsod_scene_header, encoding) == 16, "encoding at 16");
SAMSOD_ASSERT(offsetof(samsod_scene_header, reserved) == 20, "reserved at 20");

#endif
