/* Poses of compiled streams: igtl_gateway/convert/express.py documents the conversions; without Python.
 *
 * All arithmetic is IEEE 754 double precision in the order of poses.py.  The build options prevent that the compiler
 * contracts or reorders it (-ffp-contract=off, no -ffast-math).
 */
#ifndef IGTL_GATEWAY_POSES_H
#define IGTL_GATEWAY_POSES_H

#include <math.h>

#include "_metadata.h"

static const double ROUNDING = 1e-5;
static const double BEYOND_FLOAT32 = 0x1.ffffffp127; /* from here on numbers round to the infinity of float32 */

static double largest(double a, double b) { return b > a ? b : a; }

static int unit(const double q[4], double out[4])
{
    double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (!(length > 0.0 && length < INFINITY))
        return 0;
    for (int i = 0; i < 4; i++)
        out[i] = q[i] / length;
    return 1;
}

/* Negate q if its last component other than 0 is negative: q and -q are the same rotation. */
static void positive(double q[4])
{
    for (int i = 3; i >= 0; i--)
        if (q[i] != 0.0) {
            if (q[i] < 0.0)
                for (int j = 0; j < 4; j++)
                    q[j] = -q[j];
            return;
        }
}

static int pose_of_matrix(const double m[12], double out[4])
{
    const double a = m[0], b = m[3], c = m[6], d = m[1], e = m[4], f = m[7], g = m[2], h = m[5], i = m[8];
    double off = fabs(a * a + d * d + g * g - 1.0);
    off = largest(off, fabs(b * b + e * e + h * h - 1.0));
    off = largest(off, fabs(c * c + f * f + i * i - 1.0));
    off = largest(off, fabs(a * b + d * e + g * h));
    off = largest(off, fabs(a * c + d * f + g * i));
    off = largest(off, fabs(b * c + e * f + h * i));
    if (!(off <= ROUNDING))
        return 0;
    if (a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0)
        return 0;
    double q[4], trace = a + e + i;
    if (trace >= largest(largest(a, e), i)) {
        q[0] = h - f, q[1] = c - g, q[2] = d - b, q[3] = 1.0 + trace;
    } else if (a >= e && a >= i) {
        q[0] = 1.0 + a - e - i, q[1] = b + d, q[2] = c + g, q[3] = h - f;
    } else if (e >= i) {
        q[0] = b + d, q[1] = 1.0 - a + e - i, q[2] = f + h, q[3] = c - g;
    } else {
        q[0] = c + g, q[1] = f + h, q[2] = 1.0 - a - e + i, q[3] = d - b;
    }
    if (!unit(q, out))
        return 0;
    positive(out);
    return 1;
}

static void rotation_matrix(const double q[4], double m[9])
{
    const double x = q[0], y = q[1], z = q[2], w = q[3];
    m[0] = 1.0 - 2.0 * (y * y + z * z);
    m[3] = 2.0 * (x * y - z * w);
    m[6] = 2.0 * (x * z + y * w);
    m[1] = 2.0 * (x * y + z * w);
    m[4] = 1.0 - 2.0 * (x * x + z * z);
    m[7] = 2.0 * (y * z - x * w);
    m[2] = 2.0 * (x * z - y * w);
    m[5] = 2.0 * (y * z + x * w);
    m[8] = 1.0 - 2.0 * (x * x + y * y);
}

static int equal(const uint8_t *a, const uint8_t *b, ssize_t begin, ssize_t end)
{
    return memcmp(a + begin, b + begin, (size_t)(end - begin)) == 0;
}

/* Read the numbers of a message that equals the sample except in stamp, CRC, message id and numbers; 0 if it does not. */
static int numbers_of(const uint8_t *data, const uint8_t *sample, ssize_t size, ssize_t at, ssize_t bytes,
                      int check_crc, double *numbers)
{
    if (!equal(data, sample, 0, TICKS_AT) || !equal(data, sample, BODY_SIZE_AT, CRC_AT))
        return 0;
    if (at > HEADER_SIZE && !equal(data, sample, HEADER_SIZE, at - 4)) /* the last 4 bytes there are the message id */
        return 0;
    if (!equal(data, sample, at + bytes, size))
        return 0;
    if (check_crc && crc64(data + HEADER_SIZE, size - HEADER_SIZE) != get_u64(data + CRC_AT))
        return 0;
    for (ssize_t i = 0; i < bytes / 4; i++) {
        numbers[i] = get_f32(data + at + 4 * i);
        if (!isfinite(numbers[i]))
            return 0;
    }
    return 1;
}

/* -- streams ------------------------------------------------------------------------------------------------------ */

/* A stream of TRANSFORM or POSITION: what equals the sample is as compiled; the numbers are at `at`. */
struct igtl_poses {
    const uint8_t *sample;
    ssize_t size, at, bytes; /* bytes: MATRIX_BYTES or QUATERNION_BYTES */
    int check_crc;
    double times, by; /* lengths are multiplied by the first and divided by the second */
};

/* Make position (m) and quaternion (x, y, z, w) of finite numbers; 0: the message needs the full path. */
static int pose_of_numbers(const double *numbers, ssize_t bytes, double times, double by, double pose[7])
{
    const double *position = numbers;
    if (bytes == MATRIX_BYTES) {
        if (!pose_of_matrix(numbers, pose + 3))
            return 0;
        position = numbers + 9;
    } else {
        if (!unit(numbers + 3, pose + 3))
            return 0;
        positive(pose + 3);
    }
    for (int i = 0; i < 3; i++)
        pose[i] = position[i] * times / by;
    return 1;
}

/* Read position (m) and quaternion (x, y, z, w); 0: the message needs the full path. */
static int pose_from_igtl(const struct igtl_poses *stream, const uint8_t *data, ssize_t size, double pose[7])
{
    double numbers[12];
    return size == stream->size &&
           numbers_of(data, stream->sample, size, stream->at, stream->bytes, stream->check_crc, numbers) &&
           pose_of_numbers(numbers, stream->bytes, stream->times, stream->by, pose);
}

/* Fill stamp (UTC ns) and pose into a copy of a template, which ends with the pose. */
static void put_ros_pose(uint8_t *cdr, ssize_t size, ssize_t stamp_at, int64_t stamp_ns, const double pose[7])
{
    put_ros_stamp(cdr + stamp_at, stamp_ns);
    memcpy(cdr + size - POSE_BYTES, pose, POSE_BYTES);
}

/* Return whether a template has room for stamp and pose, or of metadata (``id_at``) for stamp and message id.  ``at``: of
 * the numbers in OpenIGTLink, behind the extended header of header version 2. */
static int has_room_for_pose(ssize_t size, ssize_t stamp_at, ssize_t id_at, ssize_t at)
{
    if (stamp_at < 0 || id_at < 0 || size < stamp_at + 8)
        return 0;
    if (id_at)
        return at >= HEADER_SIZE + EXTENDED_SIZE && size >= MESSAGE_ID_BYTES && id_at <= size - MESSAGE_ID_BYTES;
    return size >= POSE_BYTES + stamp_at + 8;
}

/* ``put_ros_pose``, or for the template of metadata stamp and message id. */
static void put_ros_pose_or_id(uint8_t *cdr, ssize_t size, ssize_t stamp_at, ssize_t id_at, int64_t stamp_ns,
                               const double pose[7], const uint8_t *message)
{
    if (!id_at) {
        put_ros_pose(cdr, size, stamp_at, stamp_ns, pose);
        return;
    }
    put_ros_stamp(cdr + stamp_at, stamp_ns);
    put_message_id(cdr, id_at, message);
}

/* A stream of ROS messages of header, names and pose: what lies between the names and behind them is padding. */
struct ros_poses {
    const uint8_t *sample;
    ssize_t size, first_end, second, end, bytes; /* bytes: those of the numbers in OpenIGTLink */
    double times, by;
};

/* Make the numbers for OpenIGTLink (mm) of a pose in CDR; 0: the message needs the full path. */
static int numbers_of_pose(const uint8_t *cdr, ssize_t bytes, double times, double by, double numbers[12])
{
    double pose[7], q[4], *position = numbers;
    memcpy(pose, cdr, POSE_BYTES);
    for (int i = 0; i < 7; i++)
        if (!isfinite(pose[i]))
            return 0;
    if (!unit(pose + 3, q))
        return 0;
    if (bytes == MATRIX_BYTES) {
        rotation_matrix(q, numbers);
        position = numbers + 9;
    } else {
        memcpy(numbers + 3, q, sizeof q);
    }
    for (int i = 0; i < 3; i++) {
        position[i] = pose[i] * times / by;
        if (!(fabs(position[i]) < BEYOND_FLOAT32))
            return 0;
    }
    return 1;
}

/* Read the stamp of the header (UTC ns) and the numbers for OpenIGTLink (mm); 0: the message needs the full path. */
static int pose_from_ros(const struct ros_poses *stream, const uint8_t *cdr, ssize_t size, int64_t *header_ns,
                         double numbers[12])
{
    const uint8_t *sample = stream->sample;
    if (size != stream->size || !equal(cdr, sample, 0, 4) || !equal(cdr, sample, NAMES_AT, stream->first_end) ||
        !equal(cdr, sample, stream->second, stream->end))
        return 0;
    int32_t seconds;
    uint32_t nanoseconds;
    memcpy(&seconds, cdr + 4, 4);
    memcpy(&nanoseconds, cdr + 8, 4);
    *header_ns = seconds * NS_PER_S + nanoseconds;
    return numbers_of_pose(cdr + size - POSE_BYTES, stream->bytes, stream->times, stream->by, numbers);
}

/* Whether the digits are those of the message's stamp; digits_at as in express.py, here and below. */
static int is_shown(ssize_t digits_at) { return digits_at < -1; }

/* Return whether the digits have room. */
static int has_digits(ssize_t digits_at, ssize_t size)
{
    if (is_shown(digits_at))
        return digits_at >= -size && STAMP_DIGITS - digits_at <= size;
    return digits_at <= 0 || (digits_at <= size && digits_at + STAMP_DIGITS <= size);
}

/* Return whether metadata with the stamp of ROS, or that of the message, has the size of that in a template. */
static int fits_digits(ssize_t digits_at, int64_t header_ns, int64_t stamp_ns)
{
    if (is_shown(digits_at))
        return !header_ns && stamp_ns >= FIRST_OF_19_DIGITS;
    return digits_at > 0 ? header_ns >= FIRST_OF_19_DIGITS : !(digits_at < 0 && header_ns);
}

/* Write the digits, if there are any. */
static void put_stamp_digits(uint8_t *bytes, ssize_t digits_at, int64_t header_ns, int64_t stamp_ns)
{
    if (is_shown(digits_at))
        put_digits(bytes - digits_at, stamp_ns);
    else if (digits_at > 0)
        put_digits(bytes + digits_at, header_ns);
}

/* Fill numbers, digits and CRC into a copy of a template; the stamp of the header is put separately. */
static void put_igtl_pose(uint8_t *message, ssize_t size, ssize_t at, ssize_t bytes, ssize_t digits_at,
                          const double *numbers, int64_t header_ns, int64_t stamp_ns)
{
    for (ssize_t k = 0; k < bytes / 4; k++)
        put_f32(message + at + 4 * k, numbers[k]);
    put_stamp_digits(message, digits_at, header_ns, stamp_ns);
    put_u64(message + CRC_AT, crc64(message + HEADER_SIZE, size - HEADER_SIZE));
}

#endif
