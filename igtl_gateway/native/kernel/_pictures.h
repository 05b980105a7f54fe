/* Pixels of pictures whose order changes; others stay as they are, or are copied. */
#ifndef IGTL_GATEWAY_KERNEL_PICTURES_H
#define IGTL_GATEWAY_KERNEL_PICTURES_H

#include "_loops.h"

#if defined(__x86_64__)
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

#endif
