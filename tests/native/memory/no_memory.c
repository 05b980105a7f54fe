/* Preloaded into a process: while ``refuse`` is 1, the native passage gets no zeroed memory, as for what it notes.
 *
 * The memory of anything else, also of the middleware's, is as always: it asks from another library. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stddef.h>
#include <string.h>

extern void *__libc_calloc(size_t number, size_t size);

_Atomic int refuse, refused;

void *calloc(size_t number, size_t size)
{
    Dl_info caller;
    if (refuse && dladdr(__builtin_return_address(0), &caller) && caller.dli_fname && strstr(caller.dli_fname, "/_passage.")) {
        refused++;
        return NULL;
    }
    return __libc_calloc(number, size);
}
