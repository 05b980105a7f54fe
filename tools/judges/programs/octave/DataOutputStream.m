% The stream that the sender for MATLAB writes to: a socket of Octave.
function stream = DataOutputStream (link)
  stream.write = @(data, at, count) send (link, uint8 (data));
  stream.flush = @() 0;
end
