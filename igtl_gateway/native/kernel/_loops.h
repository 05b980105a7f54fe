/* Loops over many numbers of bulk messages.  Arithmetic for points is single precision as in scaling.py; the variants for
 * AVX2 have the same results.
 */
#ifndef IGTL_GATEWAY_KERNEL_LOOPS_H
#define IGTL_GATEWAY_KERNEL_LOOPS_H

#if defined(__x86_64__)
#include <immintrin.h>
#define WITH_AVX2 __attribute__((target("avx2")))
#endif

#include "_forms.h"

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

#endif
