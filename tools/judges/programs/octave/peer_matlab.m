% A peer on a sender for MATLAB, in Octave, that sends what its standard input has: see foreign_peers.py.
% Called with the folder of the sender, then client HOST PORT.
warning ("off", "all");
pkg load sockets
words = argv ();
addpath (fileparts (mfilename ("fullpath")));
addpath (words{1});
link = socket (AF_INET, SOCK_STREAM, 0);
connect (link, struct ("addr", words{3}, "port", str2double (words{4})));
sender = OpenIGTLinkMessageSender (struct ("outputStream", link));
printf ("ready\n");
fflush (stdout);
while true
  line = input ("", "s");  % fgetl waits for the next line
  words = strsplit (line, " ");
  device = words{2}(2:end);
  try
    switch words{1}
      case "TRANSFORM"
        matrix = [reshape(str2double (words(4:15)), 3, 4); 0 0 0 1];
        sender.WriteOpenIGTLinkTransformMessage (device, matrix);
      case "STRING"
        plain = words{4}(2:end);
        bytes = [];
        while ! isempty (plain)
          if plain(1) == "%"
            bytes(end + 1) = hex2dec (plain(2:3));
            plain(1:3) = [];
          else
            bytes(end + 1) = plain(1);
            plain(1) = [];
          end
        end
        sender.WriteOpenIGTLinkStringMessage (device, char (bytes));
      case "IMAGE"
        size = str2double (words(4:6));
        hex = words{end}(2:end);
        data = uint8 (hex2dec (reshape (hex, 2, [])'));
        sender.WriteOpenIGTLinkImageMessage (device, reshape (data, size));
      otherwise
        error ("no function for %s", words{1});
    end
  catch failure
    printf ("error =%s\n", strrep (failure.message, " ", "%20"));
    fflush (stdout);
  end
end
