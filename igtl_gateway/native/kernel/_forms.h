/* The forms of bulk messages (strings, points, clouds, surfaces, pictures and tracking data) and what is known of compiled
 * streams of them: igtl_gateway/convert/express.py documents the conversions.
 */
#ifndef IGTL_GATEWAY_KERNEL_FORMS_H
#define IGTL_GATEWAY_KERNEL_FORMS_H

#include "_poses.h"

/* The conversions of bulk messages; the same numbers as in express.py. */
enum { TEXT = 0, POINT = 1, POINTS = 2, CLOUD = 3, PICTURE = 4, BLUE_FIRST = 5, MESH = 6, TRIANGLES = 7, TOOLS = 8, METADATA = 9, VOLUME = 10, LANDMARKS = 11, NUMBERS = 12 };

#define POINT_BYTES 136 /* name 64, group 32, rgba 4, position 12, diameter 4, owner 20 */
#define GROUP_AT 64
#define RGBA_AT 96
#define POSITION_AT 100
#define OWNER_AT 116
_Static_assert(POINT_BYTES == CRC64_ROW_BYTES && RGBA_AT == CRC64_WORD_AT, "a point without labels is a row of the CRC");
#define POLYDATA_HEAD 40
#define ROW_OF_POINTS 20 /* x, y, z, rgba, diameter */
#define ROW_OF_CLOUD 12
#define CELL_BYTES 16 /* of a triangle: the number 3, and three indices */
#define MAX_PIECES 12000000 /* surfaces.py */
#define TOOL_HEAD 22   /* of a tool, before its numbers: name 20, type, reserved */
#define TOOL_COMPARED 21
#define TOOL_TO_ROS 32 /* its row after a template: name and type, padding, offsets of stamp (0: none) and pose */
#define ROW_FROM_ROS 12 /* begin and end of a part that must be equal, offset of the pose after it (0: none) */
#define LANDMARK_TO_ROS 4 /* its row after a template: the offset of its place */
#define LANDMARK_BYTES 32 /* place and diameter there */
#define WHITE 0xFFFFFFFFu
#define MAX_TEXT 65535
#define MIB_ASCII 3

/* Bytes of content that are converted at a time: whole numbers of points, of pixels and of words. */
#define BLOCK_BYTES (480 * POINT_BYTES)

/* A compiled stream of a device, see bulk_to_ros in express.py. */
struct igtl_bulk {
    const uint8_t *sample; /* the bytes before (``at``) and after (``tail``) the content */
    ssize_t at, tail;
    int check_crc;
    double times, by;
    ssize_t landmarks; /* bytes of the points in the sample, which follow it; 0: points without labels, or others */
};

/* A form of a ROS message: its template, and its room.  ``width_at`` of tools: the bytes of one in OpenIGTLink; of
 * metadata: the place of the message id. */
struct ros_form {
    int form;
    const uint8_t *template;
    ssize_t room, stamp_at, width_at;
    ssize_t rest; /* bytes of the template after the points of a marker or the pixels of a volume; of tools and landmarks:
                   * their rows */
    ssize_t count, cells; /* points and triangles, see prepare_form */
    ssize_t size;  /* of the message; 0: the row does not apply */
    uint8_t *out;
};

/* A compiled stream of a topic, see bulk_to_igtl in express.py. */
struct ros_bulk {
    const uint8_t *sample; /* the bytes before the content */
    ssize_t size;
    int form;
    ssize_t height_at, data_at;   /* of clouds and pictures; of a marker: those of its pose and of its points; of tools:
                                   * their number, and the size of the message, which their content and rows follow; of
                                   * numbers the same with the number of rows */
    ssize_t step, x, y, z;        /* of the points of a cloud; step of a picture: the size of its data, of tools: that of
                                   * one, of numbers: that of the content; x of a marker: the bytes from the number of its points to these */
    const ssize_t *places;        /* begin and end of each part of the sample that must be equal */
    ssize_t places_count;         /* numbers in ``places`` */
    double times, by;
};

/* What a ROS message has for the content. */
struct found {
    const uint8_t *data; /* the text, the first point or the pixels */
    ssize_t count;       /* its size in bytes, or the number of points */
    const uint8_t *triangles;
    ssize_t cells; /* triangles of a mesh */
    ssize_t size;  /* of the content in OpenIGTLink */
    int64_t header_ns;   /* stamp in UTC ns, 0 = unset */
};

/* A form of an OpenIGTLink message: the bytes before and after the content, and the digits in the latter. */
struct igtl_form {
    const uint8_t *head, *tail;
    ssize_t head_size, tail_size, digits_at;
    uint8_t *out;
};

#endif
