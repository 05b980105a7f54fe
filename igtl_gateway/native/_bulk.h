/* Strings, points, clouds, surfaces, pictures and tracking data of compiled streams: igtl_gateway/convert/express.py documents the conversions;
 * without Python.
 *
 * A large content is converted in blocks that fit the processor's cache, and the CRC of a block is taken while it is
 * there: each byte is read from and written to memory once.  Arithmetic for points is single precision as in scaling.py;
 * the variants for AVX2 have the same results.
 */
#ifndef IGTL_GATEWAY_BULK_H
#define IGTL_GATEWAY_BULK_H

#include "_metadata.h"
#include "_poses.h"

#if defined(__x86_64__)
#include <immintrin.h>
#define WITH_AVX2 __attribute__((target("avx2")))
#endif

/* The conversions of bulk messages; the same numbers as in express.py. */
enum { TEXT = 0, POINT = 1, POINTS = 2, CLOUD = 3, PICTURE = 4, BLUE_FIRST = 5, MESH = 6, TRIANGLES = 7, TOOLS = 8, METADATA = 9, VOLUME = 10, LANDMARKS = 11 };

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

/* Whether the processor has AVX2. */
static int has_avx2;

/* Look at the processor; to be called before anything else here.  ``allowed``: 0 for the loops without AVX2. */
static inline void begin_bulk(int allowed)
{
#if defined(__x86_64__)
    __builtin_cpu_init();
    has_avx2 = allowed && __builtin_cpu_supports("avx2");
#else
    (void)allowed;
#endif
}

static inline uint32_t get_u32_ros(const uint8_t *at)
{
    uint32_t word;
    memcpy(&word, at, 4);
    return word;
}

static inline void put_u32_ros(uint8_t *at, uint32_t word) { memcpy(at, &word, 4); }

/* Scale a length in single precision, with one rounding: one of the two factors is 1. */
static inline float scaled(uint32_t word, float times, float by) { return float_of(word) * times / by; }

/* Return whether a float is NaN or infinity: all bits of its exponent are set. */
static inline uint32_t not_finite(uint32_t word) { return (word & 0x7F800000u) == 0x7F800000u; }

/* -- loops over many numbers: each returns 0, or another number for a message that needs the full path ---------------- */

#define INLINE static inline __attribute__((always_inline))

/* Scale words of big-endian floats to little-endian ones. */
INLINE uint32_t floats_to_ros_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, float times,
                                   float by)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        uint32_t word = word_of(scaled(get_u32(from + 4 * i), times, by));
        odd |= not_finite(word);
        put_u32_ros(to + 4 * i, word);
    }
    return odd;
}

/* Scale words of little-endian floats to big-endian ones. */
INLINE uint32_t floats_to_igtl_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, float times,
                                    float by)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        uint32_t word = word_of(scaled(get_u32_ros(from + 4 * i), times, by));
        odd |= not_finite(word);
        put_u32(to + 4 * i, word);
    }
    return odd;
}

/* Scale big-endian floats to little-endian doubles. */
INLINE uint32_t floats_to_doubles_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, double times,
                                       double by)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        uint32_t word = get_u32(from + 4 * i);
        double value = (double)float_of(word) * times / by;
        odd |= not_finite(word);
        memcpy(to + 8 * i, &value, 8);
    }
    return odd;
}

/* Scale little-endian doubles to big-endian floats. */
INLINE uint32_t doubles_to_floats_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, double times,
                                       double by)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        double value;
        memcpy(&value, from + 8 * i, 8);
        uint32_t word = word_of((float)(value * times / by));
        odd |= not_finite(word);
        put_u32(to + 4 * i, word);
    }
    return odd;
}

/* Copy the indices of triangular cells, which must be below ``points``. */
INLINE uint32_t cells_to_ros_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, uint32_t points)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        odd |= get_u32(from + CELL_BYTES * i) ^ 3;
        for (int corner = 0; corner < 3; corner++) {
            uint32_t index = get_u32(from + CELL_BYTES * i + 4 + 4 * corner);
            odd |= index >= points;
            put_u32_ros(to + 12 * i + 4 * corner, index);
        }
    }
    return odd;
}

/* Write triangular cells of indices, which must be below ``points``. */
INLINE uint32_t cells_to_igtl_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count, uint32_t points)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++) {
        put_u32(to + CELL_BYTES * i, 3);
        for (int corner = 0; corner < 3; corner++) {
            uint32_t index = get_u32_ros(from + 12 * i + 4 * corner);
            odd |= index >= points;
            put_u32(to + CELL_BYTES * i + 4 + 4 * corner, index);
        }
    }
    return odd;
}

/* Move and scale coordinates: those of a point are x, y, z; ``scale`` and ``move`` apply before ``times`` and ``by``. */
INLINE uint32_t moved_to_floats_loop(const uint8_t *restrict from, uint8_t *restrict to, ssize_t count,
                                     const double scale[3], const double move[3], double times, double by)
{
    enum { STEP = 12 }; /* whole points, and whole vectors */
    double scales[STEP], moves[STEP];
    uint32_t odd = 0;
    for (int i = 0; i < STEP; i++)
        scales[i] = scale[i % 3], moves[i] = move[i % 3];
    for (ssize_t begin = 0; begin < count; begin += STEP) {
        int until = count - begin < STEP ? (int)(count - begin) : STEP;
        for (int i = 0; i < until; i++) {
            double value;
            memcpy(&value, from + 8 * (begin + i), 8);
            uint32_t word = word_of((float)((value * scales[i] + moves[i]) * times / by));
            odd |= not_finite(word);
            put_u32(to + 4 * (begin + i), word);
        }
    }
    return odd;
}

/* Write triangular cells of the points ``first``, ``first`` + 1 … */
INLINE uint32_t put_triangles_loop(uint8_t *to, ssize_t count, uint32_t first)
{
    for (ssize_t i = 0; i < count; i++) {
        put_u32(to + CELL_BYTES * i, 3);
        for (uint32_t corner = 0; corner < 3; corner++)
            put_u32(to + CELL_BYTES * i + 4 + 4 * corner, first + 3 * (uint32_t)i + corner);
    }
    return 0;
}

/* Write the scaled corners of triangular cells; ``places``: the big-endian floats of ``points`` points. */
INLINE uint32_t corners_to_ros_loop(const uint8_t *restrict cells, uint8_t *restrict to, ssize_t count,
                                    const uint8_t *restrict places, uint32_t points, double times, double by)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++, cells += CELL_BYTES, to += 72) {
        odd |= get_u32(cells) ^ 3;
        for (int corner = 0; corner < 3; corner++) {
            uint32_t index = get_u32(cells + 4 + 4 * corner);
            if (index >= points)
                return 1;
            odd |= floats_to_doubles_loop(places + 12 * (ssize_t)index, to + 24 * corner, 3, times, by);
        }
    }
    return odd;
}

/* Compare words with ``first``, ``first`` + 1 … */
INLINE uint32_t are_numbers_loop(const uint8_t *from, ssize_t count, uint32_t first)
{
    uint32_t odd = 0;
    for (ssize_t i = 0; i < count; i++)
        odd |= get_u32(from + 4 * i) ^ (first + (uint32_t)i);
    return odd;
}

/* Write ``first``, ``first`` + 1 … */
INLINE uint32_t put_numbers_loop(uint8_t *to, ssize_t count, uint32_t first)
{
    for (ssize_t i = 0; i < count; i++)
        put_u32(to + 4 * i, first + (uint32_t)i);
    return 0;
}

/* Look for NUL and for bytes that are not ASCII. */
INLINE uint32_t plain_text_loop(const uint8_t *text, ssize_t size)
{
    uint8_t odd = 0;
    for (ssize_t i = 0; i < size; i++)
        odd |= (uint8_t)(text[i] - 1) | text[i];
    return odd & 0x80;
}

/* The function NAME for the processor: its loop compiled twice. */
#if defined(__x86_64__)
#define TWICE(NAME, PARAMETERS, ...)                                                                                   \
    WITH_AVX2 static uint32_t NAME##_avx2 PARAMETERS { return NAME##_loop(__VA_ARGS__); }                              \
    static inline uint32_t NAME PARAMETERS { return has_avx2 ? NAME##_avx2(__VA_ARGS__) : NAME##_loop(__VA_ARGS__); }
#else
#define TWICE(NAME, PARAMETERS, ...)                                                                                   \
    static inline uint32_t NAME PARAMETERS { return NAME##_loop(__VA_ARGS__); }
#endif

TWICE(floats_to_ros, (const uint8_t *from, uint8_t *to, ssize_t count, float times, float by), from, to, count, times,
      by)
TWICE(floats_to_igtl, (const uint8_t *from, uint8_t *to, ssize_t count, float times, float by), from, to, count, times,
      by)
TWICE(floats_to_doubles, (const uint8_t *from, uint8_t *to, ssize_t count, double times, double by), from, to, count,
      times, by)
TWICE(doubles_to_floats, (const uint8_t *from, uint8_t *to, ssize_t count, double times, double by), from, to, count,
      times, by)
TWICE(cells_to_ros, (const uint8_t *from, uint8_t *to, ssize_t count, uint32_t points), from, to, count, points)
TWICE(cells_to_igtl, (const uint8_t *from, uint8_t *to, ssize_t count, uint32_t points), from, to, count, points)
TWICE(moved_to_floats,
      (const uint8_t *from, uint8_t *to, ssize_t count, const double scale[3], const double move[3], double times,
       double by),
      from, to, count, scale, move, times, by)
TWICE(put_triangles, (uint8_t *to, ssize_t count, uint32_t first), to, count, first)
TWICE(corners_to_ros,
      (const uint8_t *cells, uint8_t *to, ssize_t count, const uint8_t *places, uint32_t points, double times, double by),
      cells, to, count, places, points, times, by)
TWICE(are_numbers, (const uint8_t *from, ssize_t count, uint32_t first), from, count, first)
TWICE(put_numbers, (uint8_t *to, ssize_t count, uint32_t first), to, count, first)
TWICE(plain_text, (const uint8_t *text, ssize_t size), text, size)

/* Positions of a PointCloud2. */
struct points {
    const uint8_t *first;
    ssize_t step, x, y, z; /* bytes from one point to the next, and to the coordinates */
    float times, by;
};

/* First bytes of name, group and owner.  If one is not 0, a list with labels is published, too. */
static uint32_t labels_of(const uint8_t *one) { return one[0] | one[GROUP_AT] | one[OWNER_AT]; }

static uint32_t place_to_igtl(const struct points *points, const uint8_t *one, uint8_t *row)
{
    uint32_t x = word_of(scaled(get_u32_ros(one + points->x), points->times, points->by));
    uint32_t y = word_of(scaled(get_u32_ros(one + points->y), points->times, points->by));
    uint32_t z = word_of(scaled(get_u32_ros(one + points->z), points->times, points->by));
    put_u32(row, x);
    put_u32(row + 4, y);
    put_u32(row + 8, z);
    return not_finite(x) | not_finite(y) | not_finite(z);
}

#if defined(__x86_64__)
/* Convert positions of which x, y and z follow one another in points of at least 16 bytes. */
WITH_AVX2 static uint32_t wide_places_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i exponent = _mm_set1_epi32(0x7F800000);
    const __m128i place = _mm_set_epi32(0, -1, -1, -1); /* the fourth word can be anything, numbers that are slow too */
    const __m128 times = _mm_set1_ps(points->times), by = _mm_set1_ps(points->by);
    const uint8_t *one = points->first + begin * points->step;
    __m128i odd = _mm_setzero_si128();
    ssize_t i = 0;
    for (; i + 1 < count; i++, one += points->step, row += 12) { /* each writes 4 bytes into the next row */
        __m128i words = _mm_and_si128(_mm_loadu_si128((const __m128i *)(const void *)(one + points->x)), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), times), by));
        odd = _mm_or_si128(odd, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        _mm_storeu_si128((__m128i *)(void *)row, _mm_shuffle_epi8(words, swap));
    }
    uint32_t last = i < count ? place_to_igtl(points, one, row) : 0;
    return last | (uint32_t)_mm_movemask_epi8(odd);
}

/* Write whole points with positions of which x, y and z follow one another; 16 bytes of each are read. */
WITH_AVX2 static uint32_t wide_points_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i exponent = _mm_set1_epi32(0x7F800000), white = _mm_set_epi32(0, 0, 0, (int)WHITE);
    const __m128i place = _mm_set_epi32(0, -1, -1, -1), none = _mm_setzero_si128();
    const __m128 times = _mm_set1_ps(points->times), by = _mm_set1_ps(points->by);
    const uint8_t *one = points->first + begin * points->step + points->x;
    __m128i odd_words = none;
    for (ssize_t i = 0; i < count; i++, one += points->step, row += POINT_BYTES) {
        __m128i words = _mm_and_si128(_mm_loadu_si128((const __m128i *)(const void *)one), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), times), by));
        odd_words = _mm_or_si128(odd_words, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        words = _mm_or_si128(_mm_shuffle_epi8(_mm_slli_si128(words, 4), swap), white);
        for (int at = 0; at < RGBA_AT; at += 32)
            _mm256_storeu_si256((__m256i *)(void *)(row + at), _mm256_setzero_si256());
        _mm_storeu_si128((__m128i *)(void *)(row + RGBA_AT), words);
        _mm_storeu_si128((__m128i *)(void *)(row + RGBA_AT + 16), none);
        _mm_storel_epi64((__m128i *)(void *)(row + POINT_BYTES - 8), none);
    }
    return (uint32_t)_mm_movemask_epi8(odd_words);
}

/* Read points without labels (``labels``: all bits; 0: with the labels of the sample): positions, colours and diameters. */
WITH_AVX2 static uint32_t wide_points_to_ros(uint8_t *row, const uint8_t *one, ssize_t count, float times, float by,
                                             uint32_t labels)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i colour = _mm_set_epi8(15, 12, 13, 14, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3); /* BGRA of RGBA */
    const __m128i exponent = _mm_set1_epi32(0x7F800000), place = _mm_set_epi32(0, -1, -1, -1);
    const __m128 wide_times = _mm_set1_ps(times), wide_by = _mm_set1_ps(by);
    __m128i odd_words = _mm_setzero_si128();
    uint32_t odd = 0;
    for (; count > 0; count--, one += POINT_BYTES, row += ROW_OF_POINTS) {
        __m128i bytes = _mm_loadu_si128((const __m128i *)(const void *)(one + RGBA_AT)); /* rgba, x, y, z */
        __m128i turned = _mm_shuffle_epi32(bytes, _MM_SHUFFLE(0, 3, 2, 1));
        __m128i words = _mm_and_si128(_mm_shuffle_epi8(turned, swap), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), wide_times), wide_by));
        odd_words = _mm_or_si128(odd_words, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        words = _mm_or_si128(words, _mm_andnot_si128(place, _mm_shuffle_epi8(turned, colour)));
        _mm_storeu_si128((__m128i *)(void *)row, words);
        uint32_t diameter = word_of(scaled(get_u32(one + POSITION_AT + 12), times, by));
        odd |= not_finite(diameter) | (labels & labels_of(one));
        put_u32_ros(row + 16, diameter);
    }
    return odd | (uint32_t)_mm_movemask_epi8(odd_words);
}

/* Swap the first and the last byte of each three; ``size`` is a multiple of 3. */
WITH_AVX2 static ssize_t swapped_blue(const uint8_t *from, uint8_t *to, ssize_t size)
{
    const __m128i swap = _mm_set_epi8(15, 12, 13, 14, 9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2);
    ssize_t i = 0;
    for (; i + 16 <= size; i += 15) { /* each writes one byte of the next pixel */
        __m128i pixels = _mm_loadu_si128((const __m128i *)(const void *)(from + i));
        _mm_storeu_si128((__m128i *)(void *)(to + i), _mm_shuffle_epi8(pixels, swap));
    }
    return i;
}
#endif

/* Convert ``count`` positions from the one numbered ``begin`` to rows of ``row_size`` bytes. */
static uint32_t places_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row, ssize_t row_size)
{
    const uint8_t *one = points->first + begin * points->step;
    int joined = points->y == points->x + 4 && points->z == points->x + 8;
    if (joined && points->step == 12 && row_size == 12)
        return floats_to_igtl(one, row, 3 * count, points->times, points->by);
#if defined(__x86_64__)
    if (has_avx2 && joined && points->step >= points->x + 16 && row_size == 12)
        return wide_places_to_igtl(points, begin, count, row);
#endif
    uint32_t odd = 0;
    for (; count > 0; count--, one += points->step, row += row_size)
        odd |= place_to_igtl(points, one, row);
    return odd;
}

/* Write whole points without labels, white and of no size. */
static uint32_t points_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    uint32_t odd = 0;
#if defined(__x86_64__)
    if (has_avx2 && points->y == points->x + 4 && points->z == points->x + 8 && points->step >= points->x + 12) {
        ssize_t most = count - 1; /* the message may end with the 12 bytes of the last one */
        odd = wide_points_to_igtl(points, begin, most, row);
        begin += most, count -= most, row += most * POINT_BYTES;
    }
#endif
    memset(row, 0, (size_t)(POINT_BYTES * count));
    for (ssize_t i = 0; i < count; i++)
        put_u32(row + POINT_BYTES * i + RGBA_AT, WHITE);
    return odd | places_to_igtl(points, begin, count, row + POSITION_AT, POINT_BYTES);
}

/* Copy pixels of blue, green and red as red, green and blue. */
static void put_blue_first(const uint8_t *from, uint8_t *to, ssize_t size)
{
    ssize_t i = 0;
#if defined(__x86_64__)
    if (has_avx2)
        i = swapped_blue(from, to, size);
#endif
    for (; i + 3 <= size; i += 3) {
        to[i] = from[i + 2];
        to[i + 1] = from[i + 1];
        to[i + 2] = from[i];
    }
}

/* -- from OpenIGTLink to ROS -------------------------------------------------------------------------------------------- */

/* A compiled stream of a device, see bulk_to_ros in express.py. */
struct igtl_bulk {
    const uint8_t *sample; /* the bytes before (``at``) and after (``tail``) the content */
    ssize_t at, tail;
    int check_crc;
    double times, by;
    ssize_t landmarks; /* bytes of the points in the sample, which follow it; 0: points without labels, or others */
};

/* The landmarks of the sample of a stream. */
static const uint8_t *landmarks_of(const struct igtl_bulk *stream) { return stream->sample + stream->at + stream->tail; }

/* Whether points have the labels and colours of those in the sample; their places and diameters may be others. */
static int has_labels(const struct igtl_bulk *stream, const uint8_t *content, ssize_t size)
{
    if (size != stream->landmarks)
        return 0;
    for (ssize_t at = 0; at < size; at += POINT_BYTES)
        if (!equal(content + at, landmarks_of(stream) + at, 0, POSITION_AT) ||
            !equal(content + at, landmarks_of(stream) + at, OWNER_AT, POINT_BYTES))
            return 0;
    return 1;
}

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

/* Return whether all but content, stamp, CRC and message id of ``data`` is as in the sample. */
static int bulk_from_igtl_fits(const struct igtl_bulk *stream, const uint8_t *data, ssize_t size)
{
    const uint8_t *sample = stream->sample;
    ssize_t at = stream->at, tail = stream->tail;
    if (size < at + tail || !equal(data, sample, 0, TICKS_AT) ||
        get_u64(data + BODY_SIZE_AT) != (uint64_t)(size - HEADER_SIZE))
        return 0;
    ssize_t extended = sample[1] == 2 ? EXTENDED_SIZE : 0; /* its last 4 bytes are the message id */
    if (extended && !equal(data, sample, HEADER_SIZE, HEADER_SIZE + EXTENDED_SIZE - 4))
        return 0;
    if (stream->landmarks && !has_labels(stream, data + at, size - at - tail))
        return 0;
    return equal(data, sample, HEADER_SIZE + extended, at) && !memcmp(data + size - tail, sample + at, (size_t)tail);
}

static int ascii_compatible(uint32_t encoding)
{
    return encoding == MIB_ASCII || encoding == 4 || encoding == 106 || encoding == 2252;
}

/* Set the number of points of POLYDATA; 0: not only points. */
static int count_cloud(const uint8_t *content, ssize_t size, ssize_t *count)
{
    if (size < POLYDATA_HEAD)
        return 0;
    uint64_t points = get_u32(content), cells = get_u32(content + 4), cells_size = get_u32(content + 8);
    for (int word = 3; word < 10; word++) /* lines, polygons, strips, attributes */
        if (get_u32(content + 4 * word))
            return 0;
    if (!points || (uint64_t)size != POLYDATA_HEAD + 12 * points + cells_size)
        return 0;
    if (cells ? cells != 1 || cells_size != 4 * (points + 1) || get_u32(content + POLYDATA_HEAD + 12 * points) != points
              : cells_size != 0)
        return 0;
    *count = (ssize_t)points;
    return 1;
}

/* Set the numbers of points and triangles of POLYDATA; 0: not only these. */
static int count_surface(const uint8_t *content, ssize_t size, struct ros_form *form)
{
    if (size < POLYDATA_HEAD)
        return 0;
    uint64_t points = get_u32(content), cells = get_u32(content + 20);
    for (int word = 1; word < 10; word++) /* vertices, lines, strips, attributes */
        if (word != 5 && word != 6 && get_u32(content + 4 * word))
            return 0;
    form->count = (ssize_t)points, form->cells = (ssize_t)cells;
    return points && cells && cells <= MAX_PIECES && get_u32(content + 24) == CELL_BYTES * cells &&
           (uint64_t)size == POLYDATA_HEAD + 12 * points + CELL_BYTES * cells;
}

/* Return the offset of the vertices in a Mesh with this number of triangles. */
static ssize_t vertices_at(ssize_t cells) { return 12 + 12 * cells + (cells & 1 ? 4 : 0); }

/* The row of a tool after the template of a form. */
static const uint8_t *tool_row(const struct ros_form *form, ssize_t tool)
{
    return form->template + form->room - form->rest + TOOL_TO_ROS * tool;
}

/* Whether the rows of tools are within the template, and one of them at least. */
static int has_tool_rows(const struct ros_form *form)
{
    ssize_t size = form->room - form->rest;
    if (size < 12 || form->rest < TOOL_TO_ROS || form->rest % TOOL_TO_ROS)
        return 0;
    if (form->width_at != TOOL_HEAD + MATRIX_BYTES && form->width_at != TOOL_HEAD + QUATERNION_BYTES)
        return 0;
    for (ssize_t i = 0; i < form->rest / TOOL_TO_ROS; i++) {
        const uint8_t *row = tool_row(form, i);
        if ((ssize_t)get_u32_ros(row + 24) > size - 8 || (ssize_t)get_u32_ros(row + 28) > size - POSE_BYTES)
            return 0;
    }
    return form->stamp_at <= size - 8;
}

/* Whether the rows of landmarks are within the template, and one of them at least. */
static int has_landmark_rows(const struct ros_form *form)
{
    ssize_t size = form->room - form->rest;
    if (size < 12 || form->rest < LANDMARK_TO_ROS || form->rest % LANDMARK_TO_ROS || form->stamp_at > size - 8)
        return 0;
    for (ssize_t at = size; at < form->room; at += LANDMARK_TO_ROS)
        if ((ssize_t)get_u32_ros(form->template + at) > size - LANDMARK_BYTES)
            return 0;
    return 1;
}

/* Whether a form that the caller has read has room for what is filled in. */
static int has_room(const struct ros_form *form)
{
    ssize_t before = form->room - form->rest;
    if (form->stamp_at < 0 || form->width_at < 0 || form->rest < 0)
        return 0;
    if (form->form == TOOLS)
        return has_tool_rows(form);
    if (form->form == LANDMARKS)
        return has_landmark_rows(form);
    return form->form == TEXT || form->form == MESH ||
           (before >= 32 && form->stamp_at + 8 <= before && form->width_at + 4 <= before);
}

/* Whether a content has the tools of a form, with these names and types. */
static int has_tools(const struct ros_form *form, const uint8_t *content, ssize_t size)
{
    if (size != form->count * form->width_at)
        return 0;
    for (ssize_t i = 0; i < form->count; i++)
        if (memcmp(content + form->width_at * i, tool_row(form, i), TOOL_COMPARED))
            return 0;
    return 1;
}

/* Set count and size of a form for this content; 0: the message needs the full path. */
static int prepare_form(struct ros_form *form, const uint8_t *content, ssize_t size)
{
    if (form->form == METADATA) {
        form->size = form->room;
        return 1;
    }
    if (form->form == LANDMARKS) {
        form->count = form->rest / LANDMARK_TO_ROS;
        form->size = form->room - form->rest;
        return size == POINT_BYTES * form->count;
    }
    if (form->form == TEXT) {
        uint32_t head = size < 4 ? 0 : get_u32(content);
        form->size = 4 + size + 1;
        return size >= 4 && size == 4 + (ssize_t)(head & 0xFFFF) && ascii_compatible(head >> 16);
    }
    if (form->form == PICTURE || form->form == VOLUME) {
        form->size = form->room + size;
        return size == (ssize_t)get_u32_ros(form->template + form->room - form->rest - 4);
    }
    if (form->form == TOOLS) {
        form->count = form->rest / TOOL_TO_ROS;
        form->size = form->room - form->rest;
        return has_tools(form, content, size);
    }
    if (form->form == MESH || form->form == TRIANGLES) {
        if (!count_surface(content, size, form))
            return 0;
        form->size = form->form == MESH ? vertices_at(form->cells) + 24 * form->count : form->room + 72 * form->cells;
        return 1;
    }
    if (form->form == CLOUD) {
        if (!count_cloud(content, size, &form->count))
            return 0;
    } else if (size && size % POINT_BYTES == 0) {
        form->count = size / POINT_BYTES;
    } else {
        return 0;
    }
    if (form->form == POINT) {
        form->size = form->count == 1 ? form->room : 0;
        return 1;
    }
    ssize_t bytes = form->count * (form->form == CLOUD ? ROW_OF_CLOUD : ROW_OF_POINTS);
    form->size = form->room + bytes + 1;
    return bytes <= UINT32_MAX;
}

static uint32_t put_point(uint8_t *out, const uint8_t *content, double times, double by, uint32_t labels)
{
    double place[3];
    for (int axis = 0; axis < 3; axis++) {
        double value = get_f32(content + POSITION_AT + 4 * axis);
        if (!isfinite(value))
            return 1;
        place[axis] = value * times / by;
    }
    memcpy(out, place, sizeof place);
    return labels & labels_of(content);
}

static uint32_t put_points(uint8_t *row, const uint8_t *one, ssize_t count, float times, float by, uint32_t labels)
{
#if defined(__x86_64__)
    if (has_avx2)
        return wide_points_to_ros(row, one, count, times, by, labels);
#endif
    uint32_t odd = 0;
    for (; count > 0; count--, one += POINT_BYTES, row += ROW_OF_POINTS) {
        for (int axis = 0; axis < 3; axis++) {
            uint32_t word = word_of(scaled(get_u32(one + POSITION_AT + 4 * axis), times, by));
            odd |= not_finite(word);
            put_u32_ros(row + 4 * axis, word);
        }
        uint32_t rgba = get_u32(one + RGBA_AT), diameter = word_of(scaled(get_u32(one + POSITION_AT + 12), times, by));
        odd |= not_finite(diameter) | (labels & labels_of(one));
        put_u32_ros(row + 12, rgba << 24 | rgba >> 8);
        put_u32_ros(row + 16, diameter);
    }
    return odd;
}

/* Write places and diameters of landmarks, each four numbers; not 0: the message needs the full path. */
static uint32_t put_landmarks(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content)
{
    const uint8_t *row = form->template + form->room - form->rest;
    uint32_t odd = 0;
    for (ssize_t i = 0; i < form->count; i++)
        odd |= floats_to_doubles(content + POINT_BYTES * i + POSITION_AT, form->out + get_u32_ros(row + LANDMARK_TO_ROS * i),
                                 4, stream->times, stream->by);
    return odd;
}

/* Write the poses of tools; not 0: the message needs the full path. */
static uint32_t put_tools(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content)
{
    ssize_t bytes = form->width_at - TOOL_HEAD;
    for (ssize_t i = 0; i < form->count; i++) {
        const uint8_t *tool = content + form->width_at * i + TOOL_HEAD;
        double numbers[12], pose[7];
        uint32_t odd = 0;
        for (ssize_t k = 0; k < bytes / 4; k++) {
            odd |= not_finite(get_u32(tool + 4 * k));
            numbers[k] = get_f32(tool + 4 * k);
        }
        if (odd || !pose_of_numbers(numbers, bytes, stream->times, stream->by, pose))
            return 1;
        memcpy(form->out + get_u32_ros(tool_row(form, i) + 28), pose, sizeof pose);
    }
    return 0;
}

/* Write the stamp of a message, or of each of its poses. */
static void put_stamps(const struct ros_form *form, int64_t stamp_ns)
{
    if (form->stamp_at)
        put_ros_stamp(form->out + form->stamp_at, stamp_ns);
    for (ssize_t i = 0; form->form == TOOLS && i < form->count; i++) {
        uint32_t stamp_at = get_u32_ros(tool_row(form, i) + 24);
        if (stamp_at)
            put_ros_stamp(form->out + stamp_at, stamp_ns);
    }
}

/* Write everything of a message but its content. */
static void put_frame(const struct ros_form *form, ssize_t size, int64_t stamp_ns)
{
    uint8_t *out = form->out;
    if (form->form == TEXT) {
        memcpy(out, "\0\1\0\0", 4);
        put_u32_ros(out + 4, (uint32_t)(size - 4 + 1));
        out[form->size - 1] = 0;
        return;
    }
    if (form->form == MESH) {
        ssize_t vertices = vertices_at(form->cells);
        memcpy(out, "\0\1\0\0", 4);
        put_u32_ros(out + 4, (uint32_t)form->cells);
        put_u32_ros(out + vertices - 4, 0); /* padding, or the next */
        put_u32_ros(out + 8 + 12 * form->cells, (uint32_t)form->count);
        return;
    }
    ssize_t before = form->room - form->rest;
    memcpy(out, form->template, (size_t)before);
    if (form->form == TRIANGLES || form->form == VOLUME)
        memcpy(out + form->size - form->rest, form->template + before, (size_t)form->rest);
    if (form->form == TRIANGLES)
        put_u32_ros(out + form->width_at, (uint32_t)(3 * form->cells));
    if (form->form == CLOUD || form->form == POINTS) {
        uint32_t bytes = (uint32_t)(form->size - form->room - 1);
        put_u32_ros(out + form->width_at, (uint32_t)form->count);
        put_u32_ros(out + form->room - 8, bytes);
        put_u32_ros(out + form->room - 4, bytes);
        out[form->size - 1] = 1; /* is_dense */
    }
    put_stamps(form, stamp_ns);
}

/* Convert a block of a surface: its points, and the triangles that end in it. */
static uint32_t put_surface_block(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content,
                                  ssize_t begin, ssize_t end)
{
    const uint8_t *places = content + POLYDATA_HEAD;
    ssize_t cells_at = POLYDATA_HEAD + 12 * form->count;
    uint32_t odd = 0, points = (uint32_t)form->count;
    if (form->form == MESH && begin < cells_at) {
        ssize_t from = begin ? begin - POLYDATA_HEAD : 0, until = (end < cells_at ? end : cells_at) - POLYDATA_HEAD;
        uint8_t *out = form->out + vertices_at(form->cells);
        odd = floats_to_doubles(places + from, out + 2 * from, (until - from) / 4, stream->times, stream->by);
    }
    if (end > cells_at) {
        ssize_t first = begin > cells_at ? (begin - cells_at) / CELL_BYTES : 0;
        ssize_t count = (end - cells_at) / CELL_BYTES - first;
        const uint8_t *cells = content + cells_at + CELL_BYTES * first;
        if (form->form == MESH)
            odd |= cells_to_ros(cells, form->out + 8 + 12 * first, count, points);
        else
            odd |= corners_to_ros(cells, form->out + form->room - form->rest + 72 * first, count, places, points,
                                  stream->times, stream->by);
    }
    return odd;
}

/* Convert the block of the content from ``begin`` to ``end``; not 0: the message needs the full path. */
static uint32_t put_block(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content,
                          ssize_t begin, ssize_t end)
{
    float times = (float)stream->times, by = (float)stream->by;
    uint32_t labels = stream->landmarks ? 0 : UINT32_MAX;
    uint8_t *out = form->out + form->room;
    if (form->form == VOLUME)
        out -= form->rest;
    if (form->form == PICTURE || form->form == VOLUME) {
        memcpy(out + begin, content + begin, (size_t)(end - begin));
        return 0;
    }
    if (form->form == TEXT) {
        if (begin == 0)
            begin = 4;
        memcpy(form->out + 4 + begin, content + begin, (size_t)(end - begin));
        return plain_text(content + begin, end - begin);
    }
    if (form->form == METADATA)
        return 0;
    if (form->form == TOOLS)
        return begin ? 0 : put_tools(form, stream, content);
    if (form->form == LANDMARKS)
        return begin ? 0 : put_landmarks(form, stream, content);
    if (form->form == POINT)
        return put_point(form->out + form->size - 24, content, stream->times, stream->by, labels);
    if (form->form == POINTS)
        return put_points(out + begin / POINT_BYTES * ROW_OF_POINTS, content + begin, (end - begin) / POINT_BYTES, times,
                          by, labels);
    uint32_t odd = 0;
    if (form->form == MESH || form->form == TRIANGLES)
        return put_surface_block(form, stream, content, begin, end);
    if (begin == 0)
        begin = POLYDATA_HEAD;
    ssize_t places_end = POLYDATA_HEAD + 12 * form->count, numbers = places_end + 4;
    if (begin < places_end) {
        ssize_t until = end < places_end ? end : places_end;
        odd = floats_to_ros(content + begin, out + begin - POLYDATA_HEAD, (until - begin) / 4, times, by);
    }
    if (end > numbers) {
        ssize_t from = begin > numbers ? begin : numbers;
        odd |= are_numbers(content + from, (end - from) / 4, (uint32_t)(from - numbers) / 4);
    }
    return odd;
}

/* Convert a message that fits to all forms, whose ``out`` have room for ``size`` bytes; 0: it needs the full path. */
static int bulk_from_igtl(const struct igtl_bulk *stream, const uint8_t *data, ssize_t size, const struct ros_form *forms,
                          ssize_t count, int64_t stamp_ns)
{
    const uint8_t *content = data + stream->at;
    ssize_t content_size = size - stream->at - stream->tail;
    for (ssize_t i = 0; i < count; i++) {
        if (forms[i].size)
            put_frame(&forms[i], content_size, stamp_ns);
        if (forms[i].form == METADATA)
            put_message_id(forms[i].out, forms[i].width_at, data);
    }
    uint64_t crc = stream->check_crc ? crc64_update(0, data + HEADER_SIZE, stream->at - HEADER_SIZE) : 0;
    for (ssize_t begin = 0; begin < content_size; begin += BLOCK_BYTES) {
        ssize_t end = content_size - begin > BLOCK_BYTES ? begin + BLOCK_BYTES : content_size;
        const uint8_t *block = content + begin;
        for (ssize_t i = 0; i < count; i++) {
            if (forms[i].size && put_block(&forms[i], stream, content, begin, end))
                return 0;
            if (forms[i].form == PICTURE)
                block = forms[i].out + forms[i].room + begin; /* a large copy is cached, its source is not */
        }
        if (stream->check_crc)
            crc = crc64_update(crc, block, end - begin);
    }
    return !stream->check_crc || crc64_update(crc, data + size - stream->tail, stream->tail) == get_u64(data + CRC_AT);
}

/* -- from ROS to OpenIGTLink -------------------------------------------------------------------------------------------- */

/* A compiled stream of a topic, see bulk_to_igtl in express.py. */
struct ros_bulk {
    const uint8_t *sample; /* the bytes before the content */
    ssize_t size;
    int form;
    ssize_t height_at, data_at;   /* of clouds and pictures; of a marker: those of its pose and of its points; of tools:
                                   * their number, and the size of the message, which their content and rows follow */
    ssize_t step, x, y, z;        /* of the points of a cloud; step of a picture: the size of its data, of tools: that of
                                   * one; x of a marker: the bytes from the number of its points to these */
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

/* Find the text of a String; 0: the message needs the full path. */
static int find_text(const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < 8)
        return 0;
    ssize_t length = get_u32_ros(cdr + 4);
    if (length > size - 8)
        return 0;
    while (length && !cdr[8 + length - 1])
        length--;
    found->data = cdr + 8;
    found->count = length;
    found->size = 4 + length;
    return length <= MAX_TEXT && !plain_text(cdr + 8, length);
}

/* Find the points of a cloud; 0: the message needs the full path. */
static int find_cloud(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < stream->data_at + 1)
        return 0;
    uint64_t height = get_u32_ros(cdr + stream->height_at), width = get_u32_ros(cdr + stream->height_at + 4);
    uint64_t row = get_u32_ros(cdr + stream->data_at - 8), length = get_u32_ros(cdr + stream->data_at - 4);
    uint64_t step = (uint64_t)stream->step;
    if (length + 1 > (uint64_t)(size - stream->data_at) || (height != 1 && row != width * step))
        return 0;
    if (!height || !width || height > length || width > length || height * width > length / step)
        return 0;
    found->count = (ssize_t)(height * width);
    found->size = POINT_BYTES * found->count;
    if (stream->form == CLOUD)
        found->size = POLYDATA_HEAD + 12 * found->count + 4 * (found->count + 1);
    return 1;
}

/* Find triangles and points of a Mesh; 0: the message needs the full path. */
static int find_mesh(const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < 8)
        return 0;
    found->cells = get_u32_ros(cdr + 4);
    found->triangles = cdr + 8;
    if (!found->cells || found->cells > (size - 12) / 12)
        return 0;
    ssize_t at = vertices_at(found->cells);
    found->count = get_u32_ros(cdr + 8 + 12 * found->cells);
    found->data = cdr + at;
    if (!found->count || found->count > (size - at) / 24)
        return 0;
    found->size = POLYDATA_HEAD + 12 * found->count + CELL_BYTES * found->cells;
    return found->size <= UINT32_MAX;
}

/* Return the offset after a string or a sequence of elements of ``size`` bytes, aligned to 4; or -1 as its argument. */
static ssize_t after_sequence(const uint8_t *cdr, ssize_t size, ssize_t at, ssize_t element)
{
    at = (at + 3) & ~(ssize_t)3;
    if (at < 4 || at > size - 4)
        return -1;
    uint64_t bytes = (uint64_t)get_u32_ros(cdr + at) * (uint64_t)element;
    return bytes > (uint64_t)(size - at - 4) ? -1 : at + 4 + (ssize_t)bytes;
}

/* Find the points of a Marker of triangles without colours; 0: the message needs the full path. */
static int find_marker(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    ssize_t at = stream->data_at;
    found->count = get_u32_ros(cdr + at - stream->x);
    found->cells = found->count / 3;
    if (!found->count || found->count % 3 || found->count > (size - at) / 24)
        return 0;
    at += 24 * found->count;
    if (size - at < 4 || get_u32_ros(cdr + at))
        return 0;
    at = after_sequence(cdr, size, at + 4, 1); /* texture_resource */
    if (at < 0 || size - at < 12)
        return 0;
    at = after_sequence(cdr, size, ((at + 3) & ~(ssize_t)3) + 8, 1); /* texture: its frame after its stamp */
    at = after_sequence(cdr, size, at, 1);                           /* its format */
    at = after_sequence(cdr, size, at, 1);                           /* its data */
    at = after_sequence(cdr, size, at, 8);                           /* uv_coordinates */
    at = after_sequence(cdr, size, at, 1);                           /* text */
    found->size = POLYDATA_HEAD + 12 * found->count + CELL_BYTES * found->cells;
    return at >= 0;
}

/* A row of the parts of a message of tools: that before all of them, one for each, and that after them. */
static const uint8_t *row_from_ros(const struct ros_bulk *stream, ssize_t row)
{
    return stream->sample + stream->data_at + stream->height_at * stream->step + ROW_FROM_ROS * row;
}

static ssize_t pose_from_row(const struct ros_bulk *stream, ssize_t tool)
{
    return get_u32_ros(row_from_ros(stream, 1 + tool) + 8);
}

/* Whether a sample has the rows of its tools, with places in it. */
static int has_rows_from_ros(const struct ros_bulk *stream)
{
    ssize_t tools = stream->height_at;
    if (tools < 1 || tools > stream->size || (stream->step != TOOL_HEAD + MATRIX_BYTES && stream->step != TOOL_HEAD + QUATERNION_BYTES) ||
        stream->data_at < 12 || stream->data_at + tools * stream->step + ROW_FROM_ROS * (tools + 2) != stream->size)
        return 0;
    for (ssize_t i = 0; i < tools + 2; i++) {
        const uint8_t *row = row_from_ros(stream, i);
        ssize_t begin = get_u32_ros(row), end = get_u32_ros(row + 4), pose = get_u32_ros(row + 8);
        if (begin > end || end > stream->data_at || pose > stream->data_at - POSE_BYTES)
            return 0;
    }
    return 1;
}

/* Find the tools of a message; 0: it needs the full path. */
static int find_tools(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size != stream->data_at)
        return 0;
    for (ssize_t i = 0; i < stream->height_at + 2; i++) {
        const uint8_t *row = row_from_ros(stream, i);
        if (!equal(cdr, stream->sample, get_u32_ros(row), get_u32_ros(row + 4)))
            return 0;
    }
    found->data = cdr;
    found->count = stream->height_at;
    found->size = stream->height_at * stream->step;
    return 1;
}

/* Write the tools of a message; return the size of the content, or -1: it needs the full path. */
static ssize_t put_tools_to_igtl(const struct ros_bulk *stream, const struct found *found, uint8_t *out)
{
    memcpy(out, stream->sample + stream->data_at, (size_t)found->size);
    for (ssize_t i = 0; i < found->count; i++) {
        double numbers[12];
        if (!numbers_of_pose(found->data + pose_from_row(stream, i), stream->step - TOOL_HEAD, stream->times, stream->by, numbers))
            return -1;
        for (ssize_t k = 0; k < (stream->step - TOOL_HEAD) / 4; k++)
            put_f32(out + stream->step * i + TOOL_HEAD + 4 * k, numbers[k]);
    }
    return found->size;
}

/* Find the content of a message; 0: it needs the full path. */
static int find_in_ros(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    ssize_t least = stream->form == TOOLS ? stream->data_at : stream->size;
    found->header_ns = 0;
    if (size < least || least < 4 || !equal(cdr, stream->sample, 0, 4))
        return 0;
    if (stream->form == TEXT)
        return find_text(cdr, size, found);
    if (stream->form == MESH)
        return find_mesh(cdr, size, found);
    for (ssize_t i = 0; i + 1 < stream->places_count; i += 2)
        if (!equal(cdr, stream->sample, stream->places[i], stream->places[i + 1]))
            return 0;
    found->data = cdr + stream->data_at;
    if (stream->form == TRIANGLES) {
        if (!find_marker(stream, cdr, size, found))
            return 0;
    } else if (stream->form == TOOLS) {
        if (!find_tools(stream, cdr, size, found))
            return 0;
    } else if (stream->form >= PICTURE) {
        found->count = found->size = stream->step;
        if (size - stream->data_at < found->size)
            return 0;
    } else if (!find_cloud(stream, cdr, size, found)) {
        return 0;
    }
    int32_t seconds;
    memcpy(&seconds, cdr + 4, 4);
    found->header_ns = seconds * NS_PER_S + get_u32_ros(cdr + 8);
    return found->size <= UINT32_MAX;
}

/* ``put_next`` for surfaces; ``block``: at most so many bytes. */
static ssize_t put_next_of_surface(const struct ros_bulk *stream, const struct found *found, uint8_t *out, ssize_t done,
                                   ssize_t block)
{
    ssize_t cells_at = POLYDATA_HEAD + 12 * found->count;
    if (done == 0) {
        memset(out, 0, POLYDATA_HEAD);
        put_u32(out, (uint32_t)found->count);
        put_u32(out + 20, (uint32_t)found->cells);
        put_u32(out + 24, (uint32_t)(CELL_BYTES * found->cells));
        return POLYDATA_HEAD;
    }
    if (done < cells_at) {
        ssize_t first = (done - POLYDATA_HEAD) / 4, count = (block < cells_at - done ? block : cells_at - done) / 4;
        const uint8_t *from = found->data + 8 * first;
        uint32_t odd;
        if (stream->form == MESH) {
            odd = doubles_to_floats(from, out + done, count, stream->times, stream->by);
        } else {
            double pose[10]; /* position, orientation (none), scale */
            memcpy(pose, stream->sample + stream->height_at, sizeof pose);
            odd = moved_to_floats(from, out + done, count, pose + 7, pose, stream->times, stream->by);
        }
        return odd ? -1 : 4 * count;
    }
    ssize_t first = (done - cells_at) / CELL_BYTES, count = block / CELL_BYTES;
    if (stream->form == TRIANGLES)
        put_triangles(out + done, count, (uint32_t)(3 * first));
    else if (cells_to_igtl(found->triangles + 12 * first, out + done, count, (uint32_t)found->count))
        return -1;
    return CELL_BYTES * count;
}

/* Write the next bytes of the content, of which ``done`` are written; return their number, or -1: the message needs the
 * full path. */
static ssize_t put_next(const struct ros_bulk *stream, const struct found *found, uint8_t *out, ssize_t done)
{
    ssize_t block = found->size - done > BLOCK_BYTES ? BLOCK_BYTES : found->size - done;
    if (stream->form == TEXT) {
        if (done == 0) {
            put_u32(out, (uint32_t)MIB_ASCII << 16 | (uint32_t)found->count);
            return 4;
        }
        memcpy(out + done, found->data + done - 4, (size_t)block);
        return block;
    }
    if (stream->form == PICTURE) {
        memcpy(out + done, found->data + done, (size_t)block);
        return block;
    }
    if (stream->form == BLUE_FIRST) {
        put_blue_first(found->data + done, out + done, block);
        return block;
    }
    if (stream->form == MESH || stream->form == TRIANGLES)
        return put_next_of_surface(stream, found, out, done, block);
    if (stream->form == TOOLS)
        return put_tools_to_igtl(stream, found, out);
    const struct points points = {.first = found->data,
                                  .step = stream->step,
                                  .x = stream->x,
                                  .y = stream->y,
                                  .z = stream->z,
                                  .times = (float)stream->times,
                                  .by = (float)stream->by};
    if (stream->form == POINTS)
        return points_to_igtl(&points, done / POINT_BYTES, block / POINT_BYTES, out + done) ? -1 : block;
    ssize_t places_end = POLYDATA_HEAD + 12 * found->count, numbers = places_end + 4;
    if (done == 0) {
        memset(out, 0, POLYDATA_HEAD);
        put_u32(out, (uint32_t)found->count);
        put_u32(out + 4, 1);
        put_u32(out + 8, (uint32_t)(4 * (found->count + 1)));
        return POLYDATA_HEAD;
    }
    if (done < places_end) {
        ssize_t count = (block < places_end - done ? block : places_end - done) / 12;
        return places_to_igtl(&points, (done - POLYDATA_HEAD) / 12, count, out + done, 12) ? -1 : 12 * count;
    }
    if (done < numbers) {
        put_u32(out + done, (uint32_t)found->count);
        return 4;
    }
    put_numbers(out + done, block / 4, (uint32_t)(done - numbers) / 4);
    return block;
}

/* Write head and tail of a message with this content; the CRC is still to be put.  Returns the CRC of the head. */
static uint64_t put_ends(const struct igtl_form *form, const struct found *found, uint8_t *head, uint8_t *tail,
                         int64_t stamp_ns)
{
    memcpy(head, form->head, (size_t)form->head_size);
    memcpy(tail, form->tail, (size_t)form->tail_size);
    put_u64(head + TICKS_AT, ns_to_ticks(stamp_ns));
    put_u64(head + BODY_SIZE_AT, (uint64_t)(form->head_size + found->size + form->tail_size - HEADER_SIZE));
    put_stamp_digits(tail, form->digits_at, found->header_ns, stamp_ns);
    return crc64_update(0, head + HEADER_SIZE, form->head_size - HEADER_SIZE);
}

/* Write all forms, whose ``out`` have room for head, content and tail; 0: the message needs the full path. */
static int bulk_from_ros(const struct ros_bulk *stream, const struct found *found, const struct igtl_form *forms,
                         ssize_t count, int64_t stamp_ns)
{
    for (ssize_t i = 0; i < count; i++) {
        const struct igtl_form *form = &forms[i];
        uint8_t *content = form->out + form->head_size, *end = content + found->size;
        uint64_t crc = put_ends(form, found, form->out, end, stamp_ns);
        const uint8_t *made = i ? forms[0].out + forms[0].head_size : NULL;
        for (ssize_t done = 0, next; done < found->size; done += next) {
            if (made) {
                next = found->size - done > BLOCK_BYTES ? BLOCK_BYTES : found->size - done;
                memcpy(content + done, made + done, (size_t)next);
            } else if ((next = put_next(stream, found, content, done)) < 0) {
                return 0;
            }
            crc = stream->form == POINTS ? crc64_update_rows(crc, content + done, next / POINT_BYTES)
                                         : crc64_update(crc, content + done, next);
        }
        put_u64(form->out + CRC_AT, crc64_update(crc, end, form->tail_size));
    }
    return 1;
}

/* Write head and tail of all forms around pixels that stay where they are; ``out`` has room for head and tail. */
static inline void frame_pixels(const struct found *found, const struct igtl_form *forms, ssize_t count, int64_t stamp_ns)
{
    for (ssize_t i = 0; i < count; i++) {
        const struct igtl_form *form = &forms[i];
        uint8_t *tail = form->out + form->head_size;
        uint64_t crc = put_ends(form, found, form->out, tail, stamp_ns);
        crc = crc64_update(crc, found->data, found->size);
        put_u64(form->out + CRC_AT, crc64_update(crc, tail, form->tail_size));
    }
}

#endif
