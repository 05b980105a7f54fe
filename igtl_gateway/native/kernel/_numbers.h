/* Numbers of joints, from ROS to OpenIGTLink. */
#ifndef IGTL_GATEWAY_KERNEL_NUMBERS_H
#define IGTL_GATEWAY_KERNEL_NUMBERS_H

#include "_forms.h"
#include "_loops.h"

#define ROW_OF_NUMBERS 12 /* begin and end of a part, and its place in the content; 0: the part must be equal */

/* A row of the parts of a message, which follow the message and its content in the sample. */
static const uint8_t *row_of_numbers(const struct ros_bulk *stream, ssize_t row)
{
    return stream->sample + stream->data_at + stream->step + ROW_OF_NUMBERS * row;
}

/* Whether a sample has its rows, with places in message and content. */
static int has_rows_of_numbers(const struct ros_bulk *stream)
{
    ssize_t rows = stream->height_at;
    if (rows < 1 || rows > stream->size || stream->data_at < 12 || stream->data_at > stream->size || stream->step < 1 ||
        stream->step > stream->size || stream->data_at + stream->step + ROW_OF_NUMBERS * rows != stream->size)
        return 0;
    for (ssize_t i = 0; i < rows; i++) {
        const uint8_t *row = row_of_numbers(stream, i);
        ssize_t begin = get_u32_ros(row), end = get_u32_ros(row + 4), to = get_u32_ros(row + 8);
        if (begin > end || end > stream->data_at || (to && ((end - begin) % 8 || to > stream->step - (end - begin))))
            return 0;
    }
    return 1;
}

/* Find the numbers of a message; 0: it needs the full path. */
static int find_numbers(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size != stream->data_at)
        return 0;
    for (ssize_t i = 0; i < stream->height_at; i++) {
        const uint8_t *row = row_of_numbers(stream, i);
        if (!get_u32_ros(row + 8) && !equal(cdr, stream->sample, get_u32_ros(row), get_u32_ros(row + 4)))
            return 0;
    }
    found->data = cdr;
    found->count = stream->height_at;
    found->size = stream->step;
    return 1;
}

/* Write the content with the numbers of a message, each of 64 bits and big-endian; return its size. */
static ssize_t put_joints(const struct ros_bulk *stream, const struct found *found, uint8_t *out)
{
    memcpy(out, stream->sample + stream->data_at, (size_t)found->size);
    for (ssize_t i = 0; i < found->count; i++) {
        const uint8_t *row = row_of_numbers(stream, i);
        const ssize_t begin = get_u32_ros(row), end = get_u32_ros(row + 4), to = get_u32_ros(row + 8);
        for (ssize_t at = begin; to && at < end; at += 8) {
            uint64_t number;
            memcpy(&number, found->data + at, sizeof number);
            put_u64(out + to + at - begin, number);
        }
    }
    return found->size;
}

#endif
